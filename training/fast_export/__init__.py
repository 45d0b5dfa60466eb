"""A trained network as an ONNX graph that is fast on a CPU, as near to the trained one as a budget in decibel asks.

What is slow in the plain export, and what is done about it:
- Large kernels: light is pooled to half or a quarter of the resolution, spread by a small kernel and brought back (gated form,
  `coarse_kernels`), or kernels become sums of few separable ones, applied as matrix products (published form, `separable`).
- Circles of confusion that a picture does not have: their part of the graph is inside an `If` and is not run (gated form).
- The layout: ONNX Runtime convolves channel by channel about ten times faster where channels come in multiples of 16. Strips of
  the picture become channels (published form).
"""
