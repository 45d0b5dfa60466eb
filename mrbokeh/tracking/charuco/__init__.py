"""Printed ChArUco boards: what they are, how they are drawn and kept in files, and how their corners are found in pictures.

board             CharucoBoard of one or more CharucoGrid; what is printed; read_board, write_board
detector          CharucoDetector: Corners in a grey picture; flow, FrameHistory: corners carried from frame to frame
board_alignment   AlignedDetector: corners from all of the print, ten times as exact out of focus
pose_from_points  poses_from_plane: the cameras that see them there, of which a plane seen from afar has two
pose_branches     PoseBranches, fits_of_shot: which of the two it is, and how sure that is
"""
