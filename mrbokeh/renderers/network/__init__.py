"""The Neural Bokeh network in an ONNX session."""
