"""Virtual scene of the viewfinder: read from a file, drawn beside the stream at its own rate, warped to every new pose.

What lies where (scene files, staged scenes and shadows are mrbokeh.scene.staging):
    overlay_source             OverlaySource: the protocol of what lies over the picture; its status; StaticLayer: a finished layer
    stage                      Stage: what the compositing thread calls; how a lost track fades; the thread that draws, and how finely
    stage_setup                one version of the scene with its renderers; what changed on disk
    drawing                    Drawing: the blurred layer with the depth, camera and lens that it was drawn for; when it is too old
    reprojection               the depth of a blurred layer, and Drawing -> Overlay at the newest pose (late reprojection)
    occlusion                  real things that hide virtual ones
    shown_scene                the views (plate, virtual, matte, depth, coc, final), what lies under a point or why nothing does, the ground
"""
