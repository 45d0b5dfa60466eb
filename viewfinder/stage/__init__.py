"""The virtual scene of the viewfinder: read from a file, drawn beside the stream at its own rate, warped to every new pose.

What lies where:
    scene_description          SceneDescription: what a scene file says
    scene_file, scene_values   the TOML file -> SceneDescription; every mistake is one sentence
    upright                    the world of the tracker -> the upright world of mrbokeh.scene (up is -y)
    staged_scene, assets       SceneDescription -> mrbokeh.scene.Scene at a moment; objects can be moved and hidden
    scene_watch                what changed on disk
    picture_box                which part of the picture must be drawn: a cropped Camera
    shadow, occlusion          the table's shadow as a layer; real things that hide virtual ones
    drawn_layer, layer_depth   Drawing: the blurred layer with the depth, camera and lens that it was drawn for
    reprojection               Drawing -> Overlay at the newest pose (late reprojection)
    redraw, resolution, fade   when a drawing is too old, how finely to draw, how a lost track fades
    stage                      Stage: what the compositing thread calls, and the thread that draws
    picking, views             what lies under a point of the picture; plate, virtual, matte, depth, coc, final
"""
