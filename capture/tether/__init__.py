"""Focus bracketing: how many slices, and a camera that takes them one after another."""
