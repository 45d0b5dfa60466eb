"""Virtual layers into a photograph that its own lens has blurred already.

    from mrbokeh.compositing.choose import insertion_of

    inserted = insertion_of("between").insert(plate, layers, renderer)
    picture = inserted.rgb

What lies where:
    base             Insertion: the protocol of every way to put layers in; Inserted: the picture in two parts, photograph and virtual light
    choose           insertion_of: by the name of the mode
    touched_box      InTouchedBox: any insertion, computed only where virtual light can arrive
    occlusion        occlusion_matte, covered_by: what the photographed scene hides, decided on sharp layers
    over             OverPhotograph: blurred layers over the photograph, with that matte where depth is known
    matte            SmoothedMatte: the same with the paper's eroded and smoothed matte
    rerender         Rerendered: all-in-focus picture and layers blurred together
    between          Between: behind what is near and blurred in the photograph, before the rest. Its steps:
      virtual_surface  the layers' depth, continued beyond their outline
      near_and_far     the sharp scene cut in two there
      clean_colours    colours under a user's matte, where there is no sharp scene
      pupil_points     points of the lens's opening
      pupil_shares     rays through them: who hides whom, and where; _between_numba
      light_points     lights, followed ray by ray
      three_parts      near, virtual and far light put together
"""
