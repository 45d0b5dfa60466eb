"""Blur solved from the slices where focus distances are not stated, and metres from what the user knows."""
