"""Pictures of lenses, kernels, stacks and solved cameras for people to look at."""
