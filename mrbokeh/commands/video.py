"""`mrbokeh video`: a virtual layer, blurred by the lens, in every frame of a clip from a fixed camera."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.atomic_files import refuse_existing
from mrbokeh.errors import InputError
from mrbokeh.image_io import read_layer
from mrbokeh.layer import Layer
from mrbokeh.lens_file import read_lens
from mrbokeh.overlay import Overlay
from mrbokeh.progress import track
from mrbokeh.renderers.choose import DEFAULT, make_renderer
from mrbokeh.video_frames import encoding_for
from mrbokeh.video_io import Frame, VideoInfo, VideoWriter, probe, read_frames

app = typer.Typer(add_completion=False)

ClipArgument = Annotated[Path, typer.Argument(metavar="CLIP", help="Video from a camera that does not move.")]
LayerOption = Annotated[Path, typer.Option(metavar="RGBAZ.exr", help="All-in-focus virtual layer: linear, premultiplied, Z in metres.")]
LensOption = Annotated[Path, typer.Option(metavar="LENS.json", help="The lens, focused as it was when the clip was shot.")]
OutOption = Annotated[Path, typer.Option(metavar="VIDEO", help=".mov (ProRes 4444), .mp4 (H.264) or .mkv (FFV1, lossless).")]
RendererOption = Annotated[str, typer.Option("--renderer", "--method", help="polygon, low-rank, scatter, or a network (.onnx).")]
FramesOption = Annotated[str, typer.Option(metavar="START:STOP", help="Frames to take, counted from 0; STOP is left out.")]
EncodingOption = Annotated[
    str | None, typer.Option(help="h264, h264-10bit, prores4444, prores422 or ffv1; by default the usual one of OUT.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace OUT where it exists.")]


@app.command()
def video(
    clip: ClipArgument,
    layer: LayerOption,
    lens: LensOption,
    out: OutOption,
    renderer: RendererOption = DEFAULT,
    frames: FramesOption = ":",
    encoding: EncodingOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Blur a virtual layer once with the lens and lay it over each frame in linear light; sound and times are kept.

    Example: mrbokeh video clip.mp4 --layer lantern.exr --lens lens.json --out lantern_in_clip.mov --frames 0:50
    """
    refuse_existing(out, overwrite)
    encoding_for(out, encoding)
    start, stop = parse_frames(frames)
    info = probe(clip)
    virtual = _layer_of_size(layer, info, clip)
    blurred = Overlay.of(make_renderer(renderer).render([virtual], read_lens(lens)))
    total = None if info.frame_count is None else max(0, min(info.frame_count, stop or info.frame_count) - start)
    pictures = read_frames(clip, start, stop)
    first = next(pictures, None)
    if first is None:
        raise InputError(f"--frames {frames} leaves nothing of {clip}: expected a range within its {info.frame_count or ''} frames")
    begin_s = first.time_s if start else 0.0
    with VideoWriter(
        out,
        info.width_px,
        info.height_px,
        info.frame_rate,
        info.time_base,
        encoding=encoding,
        audio_from=clip,
        audio_start_s=begin_s,
    ) as writer:
        for picture in track(_chain(first, pictures), "compositing", total or 0):
            writer.write(blurred.over(picture.rgb), picture.time_s - begin_s)
    typer.echo(f"wrote {out} ({info.width_px}x{info.height_px} px, {writer.frame_count} frames, {writer.audio_note})")


def parse_frames(text: str) -> tuple[int, int | None]:
    """START:STOP, either of which may be missing, as (first frame, first one left out or None)."""
    start, colon, stop = text.partition(":")
    try:
        parsed = int(start or 0), int(stop) if stop else None
    except ValueError:
        parsed = (-1, None)
    if not colon or parsed[0] < 0 or (parsed[1] is not None and parsed[1] <= parsed[0]):
        raise InputError(f"--frames: expected START:STOP with START below STOP, such as 0:50 or 100:, got {text!r}")
    return parsed


def _layer_of_size(path: Path, info: VideoInfo, clip: Path) -> Layer:
    layer = read_layer(path)
    if (layer.width_px, layer.height_px) != (info.width_px, info.height_px):
        sizes = f"{path} is {layer.width_px}x{layer.height_px} px but {clip} is {info.width_px}x{info.height_px} px"
        raise InputError(f"{sizes}: render the layer in the size of the clip")
    return layer


def _chain(first: Frame, rest: Iterator[Frame]) -> Iterator[Frame]:
    yield first
    yield from rest
