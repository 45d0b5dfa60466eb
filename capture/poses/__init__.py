"""Camera poses of several viewpoints, found by COLMAP."""
