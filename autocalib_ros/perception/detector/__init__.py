"""Object detection of vehicles and people by an ONNX model; onnxruntime is imported only if a model is configured."""
