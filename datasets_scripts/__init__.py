"""Makers of data sets: ray-traced truth and converters. Each runs by `python -m datasets_scripts.NAME`."""
