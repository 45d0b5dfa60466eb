"""Pictures of lenses, kernels and stacks for people to look at."""
