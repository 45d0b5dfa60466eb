"""Clips with virtual objects, frame by frame: the command `video`, and `dataset synthesize`.

shot              Shot: a stretch of a clip, cut into segments that are rendered independently
render_shot       a shot from beginning to end: missing segments are rendered, what is finished is kept, all are joined
executors         who renders segments: this process, worker processes, a Dask cluster; claims: who works on what
composite_recipe  pixels of one frame: layers in the clip, blurred by its lens as it is focused there
inputs            protocols of what a frame needs; frame_sources, layer_sources: where it comes from
proxies           the same shot in fewer pixels
synthesis         focal stacks computed from pictures with depth
"""
