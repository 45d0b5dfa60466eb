"""Laplacian spreadlets: sums of sparse Laplacians, integrated once."""
