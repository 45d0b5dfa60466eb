"""Metres: the scale of a reconstruction and the focus of its stacks."""
