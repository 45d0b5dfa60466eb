"""New slices of a focal stack, and one lens put in place of another."""
