"""Focal stacks merged: registered slices, depth from focus, all-in-focus pictures, and metres."""
