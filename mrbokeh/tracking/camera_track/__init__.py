"""Where a moving camera was in every frame, how it was focused, and files that tell it.

    track = read_track("shot.chan", TrackOptions(size_px=(1920, 1080)))
    camera = upright_camera(track.at(12).camera, track.up)        # in the world in which scenes stand
    metres = read_focus_pull("venice.csv").smoothed().at(12)

What lies where:
    track               CameraTrack, TrackedFrame: cameras by frame number or by time
    between_frames      interpolated: rotations along the shortest arc, places along lines, focus in dioptres
    world_axes          the axes of OpenGL's cameras and of worlds with another axis up
    formats             read_track, write_track; the files are track_file (ours), chan_file, nerfstudio_file, colmap_file, opentrackio_file
    opentrackio_sample  one sample of it, from a file or a live tracking system; stage_axes has the axes of such stages
    focus_pull          FocusPull: the focus distance by frame; focus_metadata reads that of cine cameras, focus_steps smooths it
    board_track         the track of a clip in which a printed board is seen: board_corners finds it, board_calibration the camera,
                        board_smoothing and steady_poses keep the poses from trembling more than the camera did
"""
