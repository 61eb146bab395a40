"""Vehicles and people in an image by a detector in ONNX; onnxruntime is imported only when one is asked for."""
