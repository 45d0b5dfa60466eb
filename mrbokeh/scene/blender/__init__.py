"""What runs inside Blender: `mrbokeh_export.py`, an add-on that needs nothing of mrbokeh; `mrbokeh blender-addon` copies it out."""
