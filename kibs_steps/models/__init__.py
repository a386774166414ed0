"""ONNX models: their contract, the sessions that run them, and the heads that decode them."""
