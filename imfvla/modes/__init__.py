"""What samples of a trained policy are at recorded observations: which modes they take, how they differ and join."""
