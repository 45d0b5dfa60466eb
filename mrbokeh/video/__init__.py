"""Video clips: frames decoded, encoded, joined, with their colour, alpha, sound and times.

picture_source   PictureSource: frames of a video or of numbered pictures, any stretch of them, by number; open_source
image_sequence   ImageSequence: numbered pictures (frames.%04d.exr)
clip             frames of a video decoded one after the other; VideoInfo
frames, color    stored frames to linear light and back
writer           VideoWriter, and PacketWriter for parts that are encoded already
encodings, audio encodings by name; sound carried over
"""
