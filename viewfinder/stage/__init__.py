"""The virtual scene: read from a file, drawn at its own rate, warped to the newest pose."""
