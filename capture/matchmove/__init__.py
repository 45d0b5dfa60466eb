"""Match-move: the camera of every frame of a clip, from the clip alone.

clip_matchmove     matchmove_clip: the simplest camera that explains the clip, kept, then stood in a world
clip_solve         ClipSolve: what was solved, and the folder in which it is kept
keyframes          spread evenly over the motion of the picture
flow_tracks        features followed through all frames by optical flow
simple_cameras     a camera that only turns, or one before a flat scene: all views and points at once
simple_solve       which of the two, then every frame; what moves by itself is left out
space_solve        a path through space, by COLMAP on keyframes and optical flow between them; refused where turning explains as much
ground             the world's place and the length of a metre, from pixels that people pick
solve_page         the page beside the track: how frames fit, a grid on the ground, the worst frames
"""
