"""A trained policy as ONNX graphs: what one deploys, without torch."""
