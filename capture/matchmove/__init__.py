"""The camera of every frame of a clip from what the clip shows.

keyframes          which frames COLMAP gets: spread evenly over the motion of the picture
frame_poses        the frames between: points of the model carried by flow from the keyframes around, then their pose
only_turning       turning_residual_px: whether a camera on a tripod explains the clip as well
clip_matchmove     matchmove_clip: all of it
"""
