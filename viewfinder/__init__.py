"""Camera frames in, composited stream out."""
