"""Camera poses of several viewpoints, by COLMAP."""
