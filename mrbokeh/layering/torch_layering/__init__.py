"""Layering of pictures that lie on a device: `cutting` makes slices and, when a renderer has blurred them, puts them together."""
