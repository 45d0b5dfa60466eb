"""Focus of the lens, frame by frame."""
