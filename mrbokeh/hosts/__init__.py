"""Files that run inside other programs and ask `mrbokeh serve` for blur; `mrbokeh host` writes each, without need of mrbokeh.

client          ask, blurred: the request, in the Python 3.7 of older hosts; it is put into the others' files
blender         add-on: blurs the render of the scene camera; exports objects, camera track and render settings
nuke, natron    a group with a button; fusion.fuse, in Lua, blurs in Fusion while it renders
"""
