"""Focal stacks, captures and layers of other programs, as folders and files."""
