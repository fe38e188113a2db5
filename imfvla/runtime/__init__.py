"""A trained policy as ONNX Runtime computes it, from graphs in its run directory."""
