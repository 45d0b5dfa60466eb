"""Sources of camera frames."""
