"""Where the camera is, frame by frame."""
