"""What runs inside other programs and asks `mrbokeh serve` for blur. Each is one file that imports nothing of mrbokeh.

client      ask, blurred: the request, in the Python 3.7 of older hosts; it is put into the files of the hosts
blender     add-on: blurs the render of the scene camera; exports objects, camera track and render settings
"""
