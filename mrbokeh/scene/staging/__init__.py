"""Scene files: virtual objects in the world of a camera's track, lit and with a shadow; one file for viewfinder, photo and video.

description = read_scene_file(Path("scene.toml"))
staged = StagedScene.load(description, Assets())
scene = staged.scene_at(time_s)                             # mrbokeh.scene.Scene in the upright world
camera = upright_camera(tracked_camera, description.up)     # the camera that belongs to it

scene_description   SceneDescription: content of a file; OneObject: an object described by options
scene_file          read_scene_file (TOML)
staged_scene        StagedScene: loaded, and posed at any moment; Assets: opened files, kept until they change
filming             Filming, FilmedLayers: layers of a plate
picture_box         box of the objects and their shadow in the picture
"""
