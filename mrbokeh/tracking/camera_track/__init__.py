"""Tracks: poses of a moving camera in every frame, how it was focused, and files that tell it.

    track = read_track("shot.chan", TrackOptions(size_px=(1920, 1080)))
    camera = upright_camera(track.at(12).camera, track.up)        # in the world in which scenes stand
    metres = read_focus_pull("venice.csv").smoothed().at(12)

What lies where:
    track               CameraTrack, TrackedFrame: cameras by frame number or by time, and interpolated; TrackOptions of files
    formats             read_track, write_track; our own JSON, .chan, nerfstudio; colmap_file, opentrackio_file the others
    focus_pull          FocusPull: the focus distance by frame, from keys or from what cine cameras wrote, smoothed
    board_track         the track of a clip in which a printed board is seen; its poses tremble no more than the camera did;
                        board_calibration finds the camera
"""
