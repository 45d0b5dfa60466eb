"""Match-move: the camera of every frame of a clip, from the clip alone.

clip_matchmove     matchmove_clip: keyframes for COLMAP, spread evenly over the motion of the picture, then all other frames; reasons to
                   distrust the result; refuses a camera that only rotates
frame_poses        the frames between keyframes: points of the model carried by optical flow, then the pose
ground             the world's place and the length of a metre, from pixels that people pick
"""
