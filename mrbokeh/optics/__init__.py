"""Lenses, cameras, apertures and PSFs: formulas and files, no pictures."""
