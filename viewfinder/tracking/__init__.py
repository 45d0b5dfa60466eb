"""Pose of the camera, frame by frame."""
