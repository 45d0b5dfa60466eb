"""Depth of a place seen from several viewpoints with known cameras."""

DEPTH_NAME = "depth.%06d.exr"
"""Pattern of the files that `clip_depth` writes."""
