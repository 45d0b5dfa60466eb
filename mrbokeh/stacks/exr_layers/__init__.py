"""EXR files of other programs, in and out: what Blender, Nuke, Houdini and deep renderers write becomes layers.

    sequence = ExrSequence.of("beauty.####.exr")
    for frame in sequence.frames:
        layers = sequence.layers(frame)             # sharp Layers, front first
    write_composite_exr("out.exr", CompositeLayers(rgb, virtual=virtual, matte=matte))

What lies where:
    render_channels     RenderChannels: all channels of a file by name, of its first view; FlatRender: RGBA and Z to one layer; LayerReader
    cryptomatte         Cryptomatte: mattes of objects by name; ObjectSplit: one layer per object
    deep_layers         DeepSamples: a deep picture as flat lists; DeepSurfaces: as layers; interleaved: among flat ones
    sequence            ExrSequence: numbered files, their gaps, layers of a frame
    composite_exr       CompositeLayers: our own layered EXR; sharp layers as a deep EXR
"""
