"""Where the lens is focused, frame by frame."""
