"""Layering by torch and Triton, for pictures that lie on a device: `cutting` makes slices, renderers blur them, `cutting` puts them together."""
