"""Scene files: virtual objects in the world of a camera's track, lit and with a shadow; one file for viewfinder, photo and video.

    description = read_scene_file(Path("scene.toml"))
    staged = StagedScene.load(description, Assets())
    scene = staged.scene_at(time_s)                             # mrbokeh.scene.Scene in the upright world
    camera = upright_camera(tracked_camera, description.up)     # the camera that belongs to it

What lies where:
    scene_description   SceneDescription: what the file says
    scene_file          read_scene_file (TOML); scene_values checks what it reads
    assets              Assets: opened GLB files and lighting, kept until their files change
    staged_scene        StagedScene: loaded, and posed at any moment
    upright             from the world of the track to the upright one
    picture_box         where in the picture the objects and their shadow are
"""
