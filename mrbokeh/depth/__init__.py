"""Depth of a photograph from wherever it comes: EXR, PNG with a stated meaning, a phone's photograph, stereo, a depth network."""
