"""A trained network as an ONNX graph that is fast on a CPU, as near to the trained one as a budget in decibel asks.

What is slow in the plain export, and what is done about it:
- Large kernels: light is pooled to half or a quarter of the resolution, spread by a small kernel and brought back (gated form,
  `coarse_kernels`), or kernels become sums of few separable ones, applied as matrix products (published form, `separable`).
- Bins close together for the size of their blur: fewer of them are drawn through the others (gated form, `fewer_bins`).
- Circles of confusion that a picture does not have: their part of the graph is inside an `If` and is not run; what it has is computed in
  a window around it (gated form, `gated_windows`).
- The layout: ONNX Runtime convolves channel by channel about ten times faster where channels come in multiples of 16. Strips of
  the picture become channels (published form).
"""
