"""GLB files as scenes."""
