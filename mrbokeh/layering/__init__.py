"""Layers cut into slices of depth whose kernels are summed: what all renderers that spread light share."""
