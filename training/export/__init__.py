"""Export of a trained network as ONNX: as it is (`onnx_export`), or as a graph that is fast on a CPU (`fast_onnx`).

What is slow in the plain export, and what the fast one does about it:
- Large kernels: light is pooled to half or a quarter of the resolution, spread by a small kernel and interpolated (gated form,
  `graph_builder`), or kernels become sums of a few separable ones, applied as matrix products (published form, `published_graph`).
- Bins close together for the size of their blur: fewer bins are fitted through them (gated form, `gated_weights`).
- Circles of confusion that a picture does not have: their part of the graph is inside an `If` and is not run; the others are computed
  in a window around their pixels (gated form, `gated_groups`).
- The layout: ONNX Runtime convolves channel by channel about ten times faster where channels come in multiples of 16, so strips of
  the picture become channels (published form).
"""
