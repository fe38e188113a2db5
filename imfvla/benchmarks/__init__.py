"""What this machine does in a second: simulation, demonstrations, training, inference."""
