"""`mrbokeh track`: the camera of a clip from a printed board, and camera tracks from one kind of file to another."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.commands._option_groups import grouped
from mrbokeh.system.atomic_files import refuse_existing, require_safe_outputs
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, tell, warn

if TYPE_CHECKING:
    from mrbokeh.optics.camera import Camera
    from mrbokeh.tracking.camera_track.board_track import BoardTrack
    from mrbokeh.tracking.camera_track.track import CameraTrack, Distortion, TrackOptions
    from mrbokeh.tracking.charuco.flat_prints import FlatPrint

app = typer.Typer(add_completion=False, no_args_is_help=True, help="The camera of every frame of a clip, and its files.")

OutOption = Annotated[Path, typer.Option(metavar="TRACK", help="Where the track goes; the suffix says in which format.")]
FormatOption = Annotated[
    str | None,
    typer.Option("--format", help="json, chan, nerfstudio, opentrackio, colmap or colmap-binary; by default what the name says."),
]
UpOption = Annotated[str | None, typer.Option(metavar="AXIS", help="Which axis is up in the file's world: -z, +z, -y or +y.")]
RotationOption = Annotated[str, typer.Option(metavar="ORDER", help="Of a .chan: which rotation comes first.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the track where it exists.")]


@dataclass(frozen=True)
class IntrinsicsOptions:
    """Source of the camera's intrinsics."""

    camera: Annotated[
        Path | None, typer.Option(metavar="CAMERA.json", help="Intrinsics: a camera or a track with its distortion. Else give --calibrate.")
    ] = None
    calibrate: Annotated[bool, typer.Option("--calibrate", help="Find the intrinsics from the clip itself.")] = False


@dataclass(frozen=True)
class PrintOptions:
    """The flat print in the clip. width: of the poster, in metres."""

    board: Annotated[
        Path | None,
        typer.Option(
            metavar="BOARD.json", help="A board, as `mrbokeh viewfinder board` writes it, or a .toml: ChArUco, plain chessboard or tags."
        ),
    ] = None
    poster: Annotated[
        Path | None, typer.Option(metavar="POSTER.png", help="In place of a board: any flat picture with detail, as it was printed.")
    ] = None
    width: Annotated[float | None, typer.Option(metavar="METRES", help="How wide the print of --poster is.")] = None

    def __post_init__(self) -> None:
        if (self.board is None) == (self.poster is None):
            raise InputError("expected either --board BOARD.json or --poster POSTER.png, which lies flat in the clip: give one of them")
        if (self.poster is None) != (self.width is None):
            raise InputError("--poster and --width METRES, how wide it was printed, go together: give both")

    def read(self) -> "FlatPrint":
        from mrbokeh.tracking.charuco.flat_prints import read_picture, read_print

        if self.poster is not None and self.width is not None:
            return read_picture(self.poster, self.width)
        assert self.board is not None
        return read_print(self.board)


@dataclass(frozen=True)
class SmoothingOptions:
    """Gaps to bridge, and smoothing of poses."""

    longest_gap: Annotated[int, typer.Option(min=0, metavar="FRAMES", help="Bridge so many frames in which the board is not seen.")] = 10
    smooth: Annotated[bool, typer.Option(help="Smooth poses as far as the scatter of the corners leaves them open.")] = True
    steadier: Annotated[float, typer.Option(min=0.0, metavar="PX", help="Smooth further, by so many pixels in the picture.")] = 0.0


@dataclass(frozen=True)
class ResultOptions:
    """Format and replacement of the track."""

    format_: FormatOption = None
    overwrite: OverwriteOption = False


@app.command("clip")
@grouped
def track(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="Video in which the print lies still.")],
    out: OutOption,
    shown: PrintOptions,
    known: IntrinsicsOptions,
    smoothing: SmoothingOptions,
    result: ResultOptions,
) -> None:
    """Track a clip by the printed board, or any flat picture, in it; the world of the track is the print's, in metres.

    Example: mrbokeh track clip clip.mp4 --board board.json --calibrate --out track.json

    Example: mrbokeh track clip clip.mp4 --poster poster.png --width 0.594 --calibrate --out track.json
    """
    from mrbokeh.tracking.camera_track.board_track import TrackSettings, calibrate_clip, track_board
    from mrbokeh.tracking.camera_track.formats import format_of_name

    require_safe_outputs((out,), (clip, shown.board, shown.poster, known.camera), result.overwrite)
    if result.format_ is None:
        format_of_name(out)
    if known.calibrate == (known.camera is not None):
        raise InputError("expected either --camera CAMERA.json or --calibrate, which finds the camera from the clip: give one of them")
    printed = shown.read()
    if known.camera is not None:
        intrinsics, distortion = _intrinsics(known.camera)
    else:
        found = calibrate_clip(clip, printed)
        intrinsics, distortion = found.camera, found.distortion
        say(
            f"calibrated from {found.views} frames: focal length {intrinsics.focal_px[0]:.1f} px +- {100 * found.focal_sigma:.1f} %, "
            f"{_named(found.distortion)}; corners as first read scatter by {found.residual_px:.2f} px"
        )
    settings = TrackSettings(smoothing.longest_gap, smoothing.smooth, smoothing.steadier)
    tracked = track_board(clip, printed, intrinsics, distortion, settings)
    _write(out, tracked.track, None, result.format_)
    tell(
        _told(tracked, out),
        frames=tracked.frame_count,
        frames_seen=tracked.seen,
        frames_lost=tracked.lost,
        frames_unsure=tracked.unsure,
        frames_bridged=tracked.bridged,
        residual_px=tracked.residual_px,
    )


@dataclass(frozen=True)
class FactOptions:
    """Facts that the file of IN may leave open."""

    size: Annotated[str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Size of the pictures; needed for a .chan.")] = None
    up: UpOption = None
    rotation_order: RotationOption = "ZXY"
    sensor_width: Annotated[float | None, typer.Option(min=0.1, metavar="MM", help="Of OpenTrackIO samples that do not tell it.")] = None
    metric: Annotated[
        bool | None, typer.Option("--metric/--no-metric", help="Whether lengths are metres, where the file leaves it open.")
    ] = None
    no_distortion: Annotated[bool, typer.Option("--no-distortion", help="Leave the lens distortion of IN out.")] = False


@dataclass(frozen=True)
class FrameOptions:
    """Numbers and times of the frames."""

    rate: Annotated[str | None, typer.Option(help="Frames per second: gives frames the times of their numbers.")] = None
    frame_offset: Annotated[int, typer.Option(help="Added to every frame number.")] = 0


@dataclass(frozen=True)
class ConvertedOptions:
    """World, format and replacement of OUT."""

    out_up: Annotated[str | None, typer.Option(metavar="AXIS", help="Which axis is to be up in OUT.")] = None
    format_: FormatOption = None
    overwrite: OverwriteOption = False


@app.command("convert")
@grouped
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A track: .json, .chan, .jsonl, transforms.json or a folder of COLMAP.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Where it goes; the suffix says in which format.")],
    result: ConvertedOptions,
    facts: FactOptions,
    frames: FrameOptions,
    from_: Annotated[str | None, typer.Option("--from", metavar="FORMAT", help="Format of IN; by default what the file shows.")] = None,
) -> None:
    """Turn a camera track into another format.

    Example: mrbokeh track convert track.json track.chan
    """
    from mrbokeh.tracking.camera_track.formats import read_track
    from mrbokeh.tracking.camera_track.track import TrackOptions
    from mrbokeh.video.picture_source import parse_rate

    refuse_existing(out, result.overwrite)
    options = TrackOptions(
        up=facts.up,
        size_px=_size_px(facts.size),
        rotation_order=facts.rotation_order,
        sensor_width_mm=facts.sensor_width,
        metric=facts.metric,
        keep_distortion=not facts.no_distortion,
    )
    read = read_track(source, options, from_).shifted(frames.frame_offset)
    read = read.timed(float(parse_rate(frames.rate))) if frames.rate is not None else read
    _write(out, read, TrackOptions(result.out_up, None, facts.rotation_order, facts.sensor_width), result.format_)
    unit = "" if read.metric else ", the scale of its lengths is arbitrary"
    told = f"{out}: {len(read.frames)} frames, {read.numbers[0]} to {read.numbers[-1]}, {read.size_px[0]}x{read.size_px[1]} px{unit}"
    tell(told, frames=len(read.frames), size_px=read.size_px, metric=read.metric)


def _intrinsics(path: Path) -> "tuple[Camera, Distortion | None]":
    from mrbokeh.tracking.camera_track.formats import read_track

    known = read_track(path)
    first = known.at(known.numbers[0])
    return first.camera, first.distortion


def _write(out: Path, made: "CameraTrack", options: "TrackOptions | None", format_: str | None) -> None:
    from mrbokeh.tracking.camera_track.formats import write_track

    missing = write_track(out, made, options, format_)
    if missing:
        warn(f"{out} cannot hold and lacks: {', '.join(missing)}")


def _told(tracked: "BoardTrack", out: Path) -> str:
    lost = f", {len(tracked.lost)} lost ({_ranges(tracked.lost)})" if tracked.lost else ""
    unsure = f", {len(tracked.unsure)} of unsure tilt ({_ranges(tracked.unsure)})" if tracked.unsure else ""
    bridged = f", {len(tracked.bridged)} bridged ({_ranges(tracked.bridged)})" if tracked.bridged else ""
    return (
        f"{out}: board seen in {tracked.seen} of {tracked.frame_count} frames "
        f"({100 * tracked.seen / tracked.frame_count:.1f} %){unsure}{bridged}{lost}; reprojection {tracked.residual_px:.2f} px RMS"
    )


def _ranges(numbers: tuple[int, ...]) -> str:
    """Format frame numbers as ranges such as "3-5, 9", at most six of them."""
    starts = [number for number in numbers if number - 1 not in numbers]
    ends = [number for number in numbers if number + 1 not in numbers]
    texts = [str(start) if start == end else f"{start}-{end}" for start, end in zip(starts, ends, strict=True)]
    return ", ".join(texts[:6]) + (", ..." if len(texts) > 6 else "")


def _named(distortion: "Distortion") -> str:
    return ", ".join(f"{name} {value:.3f}" for name, value in distortion.items()) or "no distortion"


def _size_px(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    try:
        width, height = (int(each) for each in text.lower().split("x"))
    except ValueError:
        width, height = 0, 0
    if width < 1 or height < 1:
        raise InputError(f"--size: expected WIDTHxHEIGHT such as 1920x1080, got {text!r}")
    return width, height
