"""Many viewpoints of one scene: camera poses, metric scale, calibration of focus, dense depth."""
