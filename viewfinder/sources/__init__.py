"""Where camera frames come from."""
