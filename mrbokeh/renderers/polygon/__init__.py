"""Polygonal directional differences: kernels as polygons, summed along their edges."""
