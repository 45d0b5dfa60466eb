"""Low-rank separable filters."""
