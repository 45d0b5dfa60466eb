"""Camera tracks, from files and from ChArUco boards."""
