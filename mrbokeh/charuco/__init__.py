"""Printed ChArUco boards: what they are, how they are drawn and kept in files, and how their corners are found in pictures.

board             CharucoBoard of one or more CharucoGrid
drawing           black_rectangles_mm: what is printed
board_file        read_board, write_board: JSON with any grids, TOML with one
detector          CharucoDetector: Corners in a grey picture
board_alignment   AlignedDetector: corners from all of the print, ten times as exact out of focus
corner_flow       flow, FrameHistory: corners carried from frame to frame
pose_from_points  pose_from_plane: the camera that sees them there
"""
