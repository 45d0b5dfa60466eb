"""Virtual layers into a photograph that its own lens has blurred already.

    from mrbokeh.compositing.choose import insertion_of

    inserted = insertion_of("over").insert(plate, layers, renderer)
    picture = inserted.rgb

What lies where:
    base        Insertion: the protocol of every way to put layers in; Inserted: the picture in two parts, photograph and virtual light
    occlusion   occlusion_matte, covered_by: what the photographed scene hides, decided on sharp layers
    over        OverPhotograph: blurred layers over the photograph, with that matte where depth is known
    choose      insertion_of: by the name of the mode
"""
