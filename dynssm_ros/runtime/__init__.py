"""The deployed predictor: model folder in, history window in, prediction out. numpy and ONNX Runtime, no torch."""
