"""Training: the loop, its state and checkpoints, schedule, average of the weights, logger."""
