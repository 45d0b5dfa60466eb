"""Where the frames of a shot come from: videos and numbered pictures, behind one protocol, any stretch of frames at once.

base             PictureSource
choose           open_source: by the name on the command line
video_source     VideoSource: seeks to the keyframe before, and counts frames exactly
frame_index      FrameIndex: which frame of a video is shown when, and where decoding can begin
image_sequence   ImageSequence: frames.%04d.exr and the like
numbered_files   the files behind such a pattern
stored_numbers   what a picture's file stores, for a colour space that the user names
"""
