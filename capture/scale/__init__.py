"""The metric scale of a reconstruction, and the focus of its stacks calibrated with it."""
