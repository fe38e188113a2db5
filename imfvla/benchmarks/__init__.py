"""How fast this machine is: simulation, demonstrations, training, inference."""
