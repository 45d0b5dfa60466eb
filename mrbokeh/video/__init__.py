"""Clips: frames decoded, encoded, joined, with their colour, alpha, sound and times."""
