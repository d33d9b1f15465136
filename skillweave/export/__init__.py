"""A trained policy as ONNX files with its state machine, for machines without this library."""
