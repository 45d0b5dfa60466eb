"""Training: FocalStack folders in, an ONNX network that blurs like one lens out."""
