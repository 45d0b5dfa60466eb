"""Printed ChArUco boards: what they are, how they are drawn and kept in files, and how their corners are found in pictures.

board        CharucoBoard of one or more CharucoGrid
drawing      black_rectangles_mm: what is printed
board_file   read_board, write_board: JSON with any grids, TOML with one
detector     CharucoDetector: Corners in a grey picture
"""
