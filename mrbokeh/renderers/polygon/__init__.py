"""Polygonal directional differences: kernels as polygons, summed along their edges.

`polygon_differences` is the renderer; `outlines` and `rectification` make polygons of openings; `directional_differences` lists a
polygon's corners; `_splat_numba` writes them pixel by pixel (the inner loop), `_differences_numba` sums them along rows.
"""
