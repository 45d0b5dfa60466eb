"""From FocalStack folders to an ONNX network that blurs like one lens."""
