"""The camera of every frame of a clip from what the clip shows.

keyframes          which frames COLMAP gets: spread evenly over the motion of the picture
frame_poses        the frames between: points of the model carried by flow from the keyframes around, then their pose
only_turning       turning_residual_px: whether a camera on a tripod explains the clip as well
ground             where the world stands and how long a metre is, from pixels that people pick (picks: as they write them)
doubts             why the result may be wrong, and refusing a camera that stood at one place
clip_matchmove     matchmove_clip: all of it
"""
