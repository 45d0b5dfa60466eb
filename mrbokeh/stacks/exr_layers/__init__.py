"""EXR files of other programs, in and out: what Blender, Nuke, Houdini and deep renderers write becomes layers.

    sequence = ExrSequence.of("beauty.####.exr", FlatRender(shutter=0.5))
    for frame in sequence.frames:
        layers = sequence.layers(frame)             # sharp Layers, front first
    write_composite_exr("out.exr", CompositeLayers(rgb, virtual=virtual, matte=matte))

What lies where:
    reader              LayerReader: what every way of reading one file is
    channel_names       the table of names that programs give to colour, depth and motion
    render_channels     RenderChannels: all channels of a file by name, of one stereo view
    flat_render         FlatRender: RGBA, Z and motion to one layer
    nearest_depth       depth of edge pixels whose own is that of the background
    murmur_hash         the hash of Cryptomatte's names
    cryptomatte         Cryptomatte: mattes of objects by name
    object_split        ObjectSplit: one layer per object, or all but some
    deep_samples        DeepSamples: a deep picture as flat lists of samples
    deep_tidy           samples sorted, volumes split and merged; the plain twin of the compiled flattening
    deep_layers         DeepSurfaces, DeepSlices: a deep picture as layers
    deep_interleaved    deep pictures among flat layers, by depth
    deep_out            sharp layers as a deep EXR
    sequence            ExrSequence: numbered files, their gaps, layers of a frame
    composite_exr       CompositeLayers: our own layered EXR
"""
