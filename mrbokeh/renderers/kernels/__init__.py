"""Kernels prepared for a method: fitted polygons, low-rank terms, spreadlets (sparse Laplacians)."""
