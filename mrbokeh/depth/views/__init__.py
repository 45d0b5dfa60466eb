"""Depth of a place seen from several viewpoints with known cameras."""
