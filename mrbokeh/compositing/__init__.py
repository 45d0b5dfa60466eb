"""Virtual layers in a photograph that its own lens has blurred already.

from mrbokeh.compositing.choose import insertion_of

inserted = insertion_of("between").insert(plate, layers, renderer)
picture = inserted.rgb

plate            Plate: the photograph; Insertion: the protocol of every mode; Inserted: its picture in two parts
open_plate       plates of photographs, slices of focal stacks, and captures of the viewfinder
choose           insertion_of: by the name of the mode; InDirtyRectangle: any mode, computed only in reach of virtual light
over             blurred layers over the photograph, hidden by its depth first, as they are or with the paper's smoothed matte
between          behind what is near and blurred in the photograph, before the rest; Rerendered: everything blurred together;
                 near, virtual and far light are put together, highlights followed ray by ray
  near_and_far     the sharp scene cut in two at the virtual surface
  edge_refinement  depth edges moved to where the photograph shows them
  pupil_shares     rays through points of the pupil: which part of it near, virtual and far surfaces take
plate_look/      exposure, white balance, falloff and grain of the photograph on virtual light
overlay          a blurred layer over many frames
stack_compositing  a virtual scene in every slice of a focal stack
"""
