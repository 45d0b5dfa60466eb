"""Photographs into the slices of focal stacks."""
