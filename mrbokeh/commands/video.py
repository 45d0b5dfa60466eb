"""`mrbokeh video`: virtual objects in every frame of a clip, blurred by its lens.

Options alone say what the shot is: what makes its frames, where they go, and which of the clip they are.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.commands import _insertion_options as shared
from mrbokeh.commands._insertion_options import (
    ColourOptions,
    LensFacts,
    LookGroup,
    VirtualOptions,
    focused_at_pixel,
    near_far_of,
    require_one_focus,
)
from mrbokeh.commands._option_groups import grouped
from mrbokeh.compositing.choose import DEFAULT_MODE, insertion_of
from mrbokeh.compositing.plate_look.finishing import LookOptions
from mrbokeh.images.carried_exr import CarriedExr
from mrbokeh.images.exr_io import ATTRIBUTE, headers_of
from mrbokeh.renderers.choose import BY_NAME, lens_and_renderer
from mrbokeh.shots.composite_recipe import CompositeRecipe
from mrbokeh.shots.executors import DaskExecutor, Executor, ProcessExecutor, SerialExecutor
from mrbokeh.shots.frame_sources import CameraFile, ClipLook, DepthFiles, FocusPulled, MatteFiles, find_depth, found_depth_files
from mrbokeh.shots.inputs import Moment
from mrbokeh.shots.layer_sources import LayerFiles, sources_by_depth, with_cryptomatte
from mrbokeh.shots.proxies import proxy_recipe
from mrbokeh.shots.render_shot import SequenceTarget, VideoTarget, render_shot
from mrbokeh.shots.shot import SEGMENT_S, Shot, Target
from mrbokeh.stacks.photograph import SensorOrientation, lens_for_orientation
from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.console import kept_when_interrupted, progress_bars
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, say, tell, warn
from mrbokeh.system.resources import cores
from mrbokeh.video.clip import has_alpha_apart
from mrbokeh.video.encodings import with_alpha
from mrbokeh.video.image_sequence import STOP, ImageSequence, is_pattern, numbered, numbers_of, require_all_there, require_missing_known
from mrbokeh.video.picture_source import PictureSource, numbers_taken, open_source, parse_rate
from mrbokeh.video.proxy_source import ProxySource, parse_proxy

ClipArgument = Annotated[
    Path,
    typer.Argument(metavar="CLIP", help="A video, or numbered pictures, with --rate: frames.%04d.exr, frames.####.exr or their folder."),
]
LensOption = Annotated[
    Path | None, typer.Option(help=f"{shared.ANY_LENS}, focused as it was when the clip was shot. Default: 50 mm f/1.8.")
]
OutOption = Annotated[
    Path,
    typer.Option(
        metavar="VIDEO", help=".mov (ProRes 4444), .mp4 (H.264), .mxf (DNxHR), .mkv (FFV1, lossless) or frames.%04d.exr|png|tif|jpg."
    ),
]


@dataclass(frozen=True)
class ClipOptions(shared.NearOptions):
    """Options of the clip: which frames are taken, their numbers, and depth."""

    rate: Annotated[
        str | None, typer.Option(help="Frames per second of numbered pictures: 25, 23.976, 24000/1001. Default: as EXR headers state.")
    ] = None
    frames: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="Frames to take, by the numbers of the files: 1001-1050, 1001-1050x2, 1001,1020.")
    ] = None
    first_number: Annotated[
        int | None,
        typer.Option(help="Number of the clip's first frame, for --frames, sequences, tracks and focus pulls; default: its file's, or 0."),
    ] = None
    missing: Annotated[
        str,
        typer.Option(
            metavar="stop|hold|black",
            help="Frames without a file: stop before the work, hold the frame before, or black. Depth and mattes are held with both.",
        ),
    ] = "stop"
    depth: Annotated[
        Path | None,
        typer.Option(
            metavar="DEPTH.exr|auto",
            help="Depth of the filmed scene in metres, one file or depth.%04d.exr. auto: found from the clip and its moving --camera.",
        ),
    ] = None
    disparity: shared.DisparityOption = None
    exact_depth: shared.ExactDepthOption = False
    steady_depth: Annotated[bool, typer.Option("--steady-depth", help="Filter numbered depth in time, against flicker.")] = False


@dataclass(frozen=True)
class RenderingOptions(shared.RenderingOptions):
    """Options of filming --scene. shutter: angle in degrees; readout, scene_begin: in seconds."""

    scene_begin: Annotated[float, typer.Option(help="Second of the clip at which the animations of --scene begin.")] = 0.0
    shutter: Annotated[
        float | None,
        typer.Option(min=0.0, max=360.0, callback=shared.in_degrees, help="Shutter angle: --scene is blurred by its motion."),
    ] = None
    readout: Annotated[float, typer.Option(help="Seconds from the first to the last row of a rolling shutter, with --shutter.")] = 0.0


@dataclass(frozen=True)
class BlurOptions:
    """Focus by frame, and the renderer."""

    focus: Annotated[float | None, typer.Option(help="Focus distance in metres in place of the lens file's; inf is allowed.")] = None
    focus_at: shared.FocusAtOption = None
    focus_pull: Annotated[
        str | None, typer.Option(metavar="KEYS|FILE.csv", help="Focus by frame: FRAME:METRES,FRAME:METRES or metadata of a camera.")
    ] = None
    renderer: Annotated[str | None, typer.Option("--renderer", help=shared.ANY_RENDERER)] = None


@dataclass(frozen=True)
class ResultOptions:
    """Options of the written result."""

    encoding: Annotated[
        str | None,
        typer.Option(
            help="h264, h264-10bit, h265-10bit, prores4444, prores4444-alpha, prores422, dnxhr-hqx, ffv1 or ffv1-alpha; by default the "
            "usual one of OUT, with alpha where CLIP has some."
        ),
    ] = None
    constant_rate: Annotated[
        str | None,
        typer.Option(
            metavar="FPS", help="Hold or leave out pictures of a clip of uneven times, so that OUT has this even rate (as MXF needs it)."
        ),
    ] = None
    virtual_only: Annotated[
        bool, typer.Option("--virtual-only", help="Write the blurred virtual layer with alpha: EXR files, .mov or .mkv.")
    ] = False
    proxy: Annotated[
        str | None, typer.Option(metavar="1/2", help="Make OUT in a part of the plate's width and height, all that is read shrunk alike.")
    ] = None
    overwrite: shared.OverwriteOption = False


@dataclass(frozen=True)
class WorkOptions:
    """Options of the workers. workers: processes here; cluster: a scheduler elsewhere; segment: in seconds."""

    workers: Annotated[int, typer.Option(min=0, help="Processes on this machine; 0 takes one for each core.")] = 0
    cluster: Annotated[str | None, typer.Option(metavar="tcp://HOST:8786", help="Dask scheduler whose workers see the same files.")] = None
    segment: Annotated[float, typer.Option(min=0.01, help="Seconds of a segment, the least that a kill can lose.")] = SEGMENT_S


if TYPE_CHECKING:
    from collections.abc import Sequence

    from mrbokeh.shots.layer_sources import SceneLayers


def recipe_of(
    source: PictureSource,
    lens: Path | None,
    facts: LensFacts,
    taken: ClipOptions,
    virtual: VirtualOptions,
    rendering: RenderingOptions,
    look: LookGroup,
    blur: BlurOptions,
    *,
    virtual_only: bool,
) -> CompositeRecipe:
    """Return the recipe of every frame. Raises InputError if options do not go together."""
    _check_virtual(virtual, rendering, finds_depth=is_auto(taken.depth))
    require_one_focus(focus=blur.focus, focus_at=blur.focus_at, focus_pull=blur.focus_pull)
    facts.on(None, lens_and_renderer(lens, blur.renderer)[1])  # refuses facts that a network cannot follow
    pull = None if blur.focus_pull is None else FocusPulled.of(blur.focus_pull)
    if pull is not None:
        pull.require_reached(_numbers(source, taken))
    holding = SensorOrientation((source.info.width_px, source.info.height_px), source.info.quarter_turns)
    objects = virtual.object_names
    files = tuple(LayerFiles(path.resolve(), objects, taken.missing) for path in virtual.layer or ())
    _require_all_there(source, files, taken)
    depth = _depth(taken, virtual, source.path)
    recipe = CompositeRecipe(
        lens=None if lens is None else lens.resolve(),
        layers=sources_by_depth(files, _scene_layers(source, virtual, rendering)),
        renderer=_renderer(blur.renderer),
        mode=virtual.mode or (DEFAULT_MODE if taken.matte is None and depth is None else "between"),
        camera=_camera(source, virtual),
        focus=pull,
        depth=depth,
        exact_depth=taken.exact_depth,
        matte=None if taken.matte is None else MatteFiles(taken.matte.resolve()),
        near_m=taken.near_distance,
        look=_look(look, source, taken),
        first_number=_first_number(source, taken),
        virtual_only=virtual_only,
        holding=holding,
        facts=tuple((facts.given | ({} if blur.focus is None else {"focus_distance_m": blur.focus})).items()),
    )
    lens_for_orientation(recipe.stated_lens, holding, source.path)  # tells once how the lens is turned, for every worker turns it alike
    return recipe


def _depth(taken: ClipOptions, virtual: VirtualOptions, clip: Path) -> DepthFiles | None:
    near_far_m = near_far_of(taken.disparity, taken.depth)
    if taken.depth is None:
        return None
    if is_auto(taken.depth):
        if near_far_m is not None or taken.steady_depth or virtual.camera is None:
            raise InputError("--depth auto needs the moving camera, --camera TRACK, and neither --disparity nor --steady-depth")
        return DepthFiles(found_depth_files(virtual.camera, clip), with_holes=True)
    # A filter over time takes numbers only.
    with_holes = not (taken.exact_depth or taken.steady_depth)
    return DepthFiles(taken.depth.resolve(), taken.steady_depth, near_far_m, with_holes=with_holes)


def is_auto(depth: Path | None) -> bool:
    """Return whether depth is to be found from the clip itself."""
    return depth is not None and str(depth) == "auto"


def _focus_at_fact(recipe: CompositeRecipe, source: PictureSource, first: int, place: str) -> tuple[str, float]:
    """Return the focus, for the whole clip, on what the depth of the first frame that is taken has at a place."""
    moment = Moment(recipe.first_number + first, 0.0, (source.info.width_px, source.info.height_px))
    depth_m = None if recipe.depth is None else recipe.depth.opened(1).depth_m_at(moment)
    lens = recipe.stated_lens if recipe.holding is None else lens_for_orientation(recipe.stated_lens, recipe.holding)
    return "focus_distance_m", focused_at_pixel(lens, depth_m, place).focus_distance_m


def target_of(out: Path, source: PictureSource, recipe: CompositeRecipe, colour: ColourOptions, result: ResultOptions) -> Target:
    if is_pattern(out):
        for name, value in (("--encoding", result.encoding), ("--constant-rate", result.constant_rate)):
            if value is not None:
                raise InputError(f"{name} {value} is for videos, but {out} are pictures: leave it out")
        return SequenceTarget(
            path=out.resolve(),
            first_number=recipe.first_number,
            layers=result.virtual_only,
            space=colour.of_result,
            renders=with_cryptomatte(recipe.layers),
        )
    keeping = with_alpha(out) if result.virtual_only or source.info.has_alpha else None
    encoding = result.encoding or keeping or ("prores4444-alpha" if result.virtual_only else None)
    sound = None if is_pattern(source.path) else source.path
    even_rate = None if result.constant_rate is None else parse_rate(result.constant_rate)
    return VideoTarget(path=out.resolve(), encoding=encoding, audio_from=sound, space=colour.of_result, even_rate=even_rate)


def segment_frames(frames: int, most: int) -> int:
    """Return the frames of a segment, so that two or four workers end together: three segments would leave one of two idle for a third.

    It depends on the shot alone, for several machines may share it.
    """
    segments = -(-frames // most)
    return -(-frames // (segments if segments < 3 else -(-segments // 4) * 4))


def shot_of(source: PictureSource, recipe: CompositeRecipe, target: Target, taken: ClipOptions, segment_s: float) -> Shot:
    numbers, first = _numbers(source, taken), _first_number(source, taken)
    return Shot(
        source=source,
        recipe=recipe,
        target=target,
        taken=[number - first for number in numbers],
        segment_frames=segment_frames(len(numbers), max(1, round(segment_s * source.info.frame_rate))),
    )


def _require_all_there(source: PictureSource, layers: "Sequence[LayerFiles]", taken: ClipOptions) -> None:
    """Raise InputError if files of frames are missing anywhere and nothing is told to stand for them, or if layers are of another rate."""
    numbers, shift = _numbers(source, taken), _first_number(source, taken) - source.first_number
    if isinstance(source, ImageSequence) and taken.missing == STOP:
        require_all_there(source.path, source.there, [number - shift for number in numbers])
    for each in layers:
        each.require_all(numbers, source.info.frame_rate)
    if taken.missing != STOP:
        return
    for path in (taken.depth, taken.matte):
        if path is not None and is_pattern(path):
            require_all_there(path, numbers_of(path), numbers)


def _numbers(source: PictureSource, taken: ClipOptions) -> "Sequence[int]":
    first = _first_number(source, taken)
    return numbers_taken(taken.frames, range(first, first + len(source.times_s)), source.path)


def _check_virtual(virtual: VirtualOptions, rendering: RenderingOptions, *, finds_depth: bool) -> None:
    if not virtual.layer and virtual.scene is None:
        raise InputError("nothing to put into the clip: give --layer RGBAZ.exr or --scene SCENE.toml")
    if virtual.mode is not None:
        insertion_of(virtual.mode)
    for_scenes = (rendering.shutter, rendering.distortion, None if finds_depth else virtual.camera)
    if virtual.scene is None and any(each is not None for each in for_scenes):
        raise InputError("--camera, --shutter and --distortion are for what --scene renders: layers in files have theirs in them")


def _scene_layers(source: PictureSource, virtual: VirtualOptions, rendering: RenderingOptions) -> "tuple[SceneLayers, ...]":
    if virtual.scene is None:
        return ()
    from mrbokeh.scene.moving_layers import ShutterTiming
    from mrbokeh.shots.layer_sources import SceneLayers

    rate, shutter = float(source.info.frame_rate), rendering.shutter
    timing = None if shutter is None else ShutterTiming(rate, shutter, readout_s=rendering.readout)
    return (SceneLayers(virtual.scene.resolve(), rendering.filming(timing), rendering.scene_begin),)


def _camera(source: PictureSource, virtual: VirtualOptions) -> CameraFile | None:
    if virtual.camera is None or virtual.scene is None:
        return None
    from mrbokeh.scene.staging.scene_file import read_scene_file

    return CameraFile.of_clip(virtual.camera.resolve(), source.info, read_scene_file(virtual.scene).up)


def _look(look: LookGroup, source: PictureSource, taken: ClipOptions) -> ClipLook | None:
    if look.wanted == LookOptions(seed=look.seed):
        return None
    first = _first_number(source, taken)
    start = _numbers(source, taken)[0] - first
    return ClipLook(
        options=look.wanted, clip=source.path, rate=taken.rate, start=start, first_number=first, space=source.space, missing=taken.missing
    )


def _first_number(source: PictureSource, taken: ClipOptions) -> int:
    return source.first_number if taken.first_number is None else taken.first_number


def _renderer(name: str | None) -> str | None:
    """Return the renderer's name, a network or bank as an absolute path, for workers may stand elsewhere."""
    return name if name is None or name in BY_NAME else str(Path(name).resolve())


app = typer.Typer(add_completion=False)


@app.command()
@grouped
def video(
    clip: ClipArgument,
    taken: ClipOptions,
    virtual: VirtualOptions,
    rendering: RenderingOptions,
    look: LookGroup,
    facts: LensFacts,
    blur: BlurOptions,
    out: OutOption,
    colour: ColourOptions,
    result: ResultOptions,
    work: WorkOptions,
    lens: LensOption = None,
) -> None:
    """Blur virtual layers with the lens and put them into each frame in linear light; sound and times are kept.

    Finished segments wait in OUT.parts: the same command goes on where it was interrupted.

    Example: mrbokeh video clip.mp4 --layer lantern.exr --lens lens.json --out lantern_in_clip.mov --frames 0-49

    Example: mrbokeh video clip.mov --scene scene.toml --camera track.json --focus-pull 0:1.2,48:3.5 --lens lens.json --out out.mp4
    """
    finds_depth = is_auto(taken.depth) and virtual.camera is not None
    depth_files = (found_depth_files(virtual.camera, clip),) if finds_depth and virtual.camera else (taken.depth,)
    require_safe_outputs((out,), (clip, *depth_files, taken.matte, *virtual.files, rendering.distortion, lens), overwrite=True)
    require_missing_known(taken.missing)
    source = open_source(clip, taken.rate, colour.of_plate, taken.missing)
    recipe = recipe_of(source, lens, facts, taken, virtual, rendering, look, blur, virtual_only=result.virtual_only)
    unfocused, unstated = blur.focus is blur.focus_at is blur.focus_pull is None, lens_and_renderer(lens, blur.renderer)[0] is None
    if unstated and not {"focal_length_mm", "f_number"} <= facts.given.keys():
        guess(f"no whole lens is stated, so that this one is taken: {recipe.stated_lens.described}")
    elif unstated and unfocused:
        guess(f"nothing tells the focus: it is taken to be at {recipe.stated_lens.focus_described} (--focus METRES)")
    if lens is not None and not lens.exists() and unfocused:
        guess(f"{lens} is focused at {recipe.stated_lens.focus_distance_m:.3g} m, for nothing tells it (--focus METRES)")
    _tell_layer_spaces(virtual, colour, shot_numbers=_numbers(source, taken))
    scale, whole, plate = parse_proxy(result.proxy), recipe, source
    if scale < 1:
        recipe, source = proxy_recipe(recipe, source.info, scale), ProxySource.of(source, scale)
    target = target_of(out, source, recipe, colour, result)
    shot = shot_of(source, recipe, target, taken, work.segment)
    target.require_new(shot, result.overwrite or shot.was_begun)
    if is_auto(taken.depth) and virtual.camera is not None:
        find_depth(plate, virtual.camera, shot.taken, recipe.first_number)
    if blur.focus_at is not None:
        focused = _focus_at_fact(whole, plate, shot.taken[0], blur.focus_at)
        recipe = replace(recipe, facts=(*recipe.facts, focused))
        shot = replace(shot, recipe=recipe)
    _try_first_frame(shot)
    if not result.virtual_only and (lost := _alpha_lost(clip, source, target)):
        warn(f"{clip} {lost}")
    if is_pattern(out) and scale == 1 and (carried := CarriedExr.of(source.file_of(shot.taken[0])).told(clip)):
        say(carried)
    note = _made(shot, _executor(work, len(shot.segments)), result.overwrite)
    frames = len(shot.taken)
    size = f"{source.info.width_px}x{source.info.height_px} px"
    used = recipe.stated_lens
    focus = "by --focus-pull" if recipe.focus is not None else f"at {used.focus_described}"
    blurred = f"{used.focal_length_mm:.4g} mm f/{used.f_number:.3g} focused {focus}"
    told = f"wrote {out} ({size}, {frames} frame{'' if frames == 1 else 's'}, {note}; {recipe.mode}; {blurred})"
    tell(told, known=used.facts, frames=frames, size_px=(source.info.width_px, source.info.height_px))


def _tell_layer_spaces(virtual: VirtualOptions, colour: ColourOptions, shot_numbers: "Sequence[int]") -> None:
    """Say which layers state no primaries, where spaces are named: they are not in the space of the plate."""
    if colour.input_space is None and colour.output_space is None:
        return
    for path in virtual.layer or ():
        first = numbered(path, shot_numbers[0])
        if first.is_file() and not any(ATTRIBUTE in header for header in headers_of(first)):
            say(f"{first.name} states no primaries (chromaticities): its colours are taken for linear Rec.709")


def _alpha_lost(clip: Path, source: PictureSource, target: Target) -> str | None:
    """Return a warning if the clip's alpha is not read, or cannot be kept, else None."""
    if source.info.has_alpha:
        return target.lacks_alpha and f"has alpha, but {target.lacks_alpha}: what it does not cover is black in {target.path.name}"
    if source.file_of(0) is None and has_alpha_apart(clip):
        return "keeps its alpha apart (VP8, VP9), where it is not read: it is taken as opaque; turn it into ProRes 4444 or FFV1 before"
    return None


def _executor(work: WorkOptions, segments: int) -> Executor:
    if work.cluster is not None:
        return DaskExecutor(work.cluster)
    count = min(work.workers or cores(), segments)
    return SerialExecutor() if count == 1 else ProcessExecutor(count)


def _try_first_frame(shot: Shot) -> None:
    """Render the first frame, so that mistakes in files and options are told at once, and not by a worker."""
    first = shot.taken[0]
    frame = next(shot.source.frames(first, first + 1))
    shot.recipe.build(1).make(first, frame.rgb, frame.time_s, frame.alpha)


def _made(shot: Shot, executor: Executor, overwrite: bool) -> str:
    with kept_when_interrupted(f"finished segments are kept in {shot.parts_path}"), progress_bars() as bars:
        task = bars.add_task("compositing", total=len(shot.taken))
        return render_shot(shot, executor, overwrite=overwrite, progress=lambda count: bars.advance(task, count))
