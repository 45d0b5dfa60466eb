"""Errors, files, progress, threads and memory: what every room stands on."""
