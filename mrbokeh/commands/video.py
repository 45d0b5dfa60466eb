"""`mrbokeh video`: virtual objects in every frame of a clip, blurred by its lens."""

from pathlib import Path

import typer

from mrbokeh.commands import _look_options as look
from mrbokeh.commands import _video_options as options
from mrbokeh.compositing.choose import DEFAULT_MODE
from mrbokeh.errors import InputError
from mrbokeh.lens_distortion.distortion_json import read_distortion
from mrbokeh.moving_layers import ShutterTiming
from mrbokeh.picture_sources.base import PictureSource
from mrbokeh.picture_sources.choose import open_source
from mrbokeh.picture_sources.numbered_files import is_pattern
from mrbokeh.plate_look.look_options import LookOptions
from mrbokeh.progress import progress_bars
from mrbokeh.renderers.choose import BY_NAME, DEFAULT
from mrbokeh.shots.clip_look import ClipLook
from mrbokeh.shots.composite_recipe import CompositeRecipe
from mrbokeh.shots.crew import Crew, OneProcess
from mrbokeh.shots.dask_crew import DaskCrew
from mrbokeh.shots.frame_sources import CameraFile, DepthFiles, FocusPulled, MatteFiles
from mrbokeh.shots.layer_sources import LayerFiles, SceneLayers
from mrbokeh.shots.making import make_shot
from mrbokeh.shots.process_crew import ProcessCrew
from mrbokeh.shots.segment import SEGMENT_S
from mrbokeh.shots.sequence_target import SequenceTarget
from mrbokeh.shots.shot import Shot, Target
from mrbokeh.shots.video_target import VideoTarget
from mrbokeh.staging.filming import Filming
from mrbokeh.workers import cores

app = typer.Typer(add_completion=False)

INTERRUPTED = 130


@app.command()
def video(
    clip: options.ClipArgument,
    lens: options.LensOption,
    out: options.OutOption,
    layer: options.LayerOption = None,
    scene: options.SceneOption = None,
    camera: options.CameraOption = None,
    scene_renderer: options.BackendOption = "auto",
    samples: options.SamplesOption = 64,
    scene_begin: options.BeginOption = 0.0,
    catch: options.CatchOption = "shadow",
    shutter: options.ShutterOption = None,
    readout: options.ReadoutOption = 0.0,
    distortion: options.DistortionOption = None,
    focus_pull: options.FocusOption = None,
    depth: options.DepthOption = None,
    steady_depth: options.SteadyOption = False,
    matte: options.MatteOption = None,
    near_distance: options.NearDistanceOption = None,
    mode: options.ModeOption = None,
    match_grey: look.MatchGreyOption = None,
    grey_value: look.GreyValueOption = 0.18,
    match_white: look.MatchWhiteOption = None,
    match_black: look.MatchBlackOption = None,
    vignetting: look.VignettingOption = None,
    grain: look.GrainOption = None,
    light_wrap: look.LightWrapOption = None,
    seed: look.SeedOption = 0,
    renderer: options.RendererOption = DEFAULT,
    frames: options.FramesOption = ":",
    rate: options.RateOption = None,
    first_number: options.NumberOption = None,
    encoding: options.EncodingOption = None,
    virtual_only: options.VirtualOption = False,
    overwrite: options.OverwriteOption = False,
    workers: options.WorkersOption = 0,
    cluster: options.ClusterOption = None,
    segment: options.SegmentOption = SEGMENT_S,
) -> None:
    """Blur virtual layers with the lens and put them into each frame in linear light; sound and times are kept.

    Finished segments wait in OUT.parts: the same command goes on where it was interrupted.

    Example: mrbokeh video clip.mp4 --layer lantern.exr --lens lens.json --out lantern_in_clip.mov --frames 0:50

    Example: mrbokeh video clip.mov --scene scene.toml --camera track.json --focus-pull 0:1.2,48:3.5 --lens lens.json --out out.mp4
    """
    source = open_source(clip, rate)
    start, stop = _range(frames, source)
    number = source.first_number if first_number is None else first_number
    if not layer and scene is None:
        raise InputError("nothing to put into the clip: give --layer RGBAZ.exr or --scene SCENE.toml")
    if scene is None and (shutter is not None or distortion is not None or camera is not None):
        raise InputError("--camera, --shutter and --distortion are for what --scene renders: layers in files have theirs in them")
    timing = None if shutter is None else ShutterTiming(float(source.info.frame_rate), shutter, readout_s=readout)
    filming = Filming(scene_renderer, samples, catches=catch, distortion=read_distortion(distortion), shutter=timing)
    in_scene = () if scene is None else (SceneLayers(scene.resolve(), filming, scene_begin),)
    wanted = LookOptions(match_grey, grey_value, None, match_white, match_black, vignetting, grain, light_wrap, seed)
    recipe = CompositeRecipe(
        lens=lens.resolve(),
        layers=(*(LayerFiles(path.resolve()) for path in layer or ()), *in_scene),
        renderer=renderer if renderer in BY_NAME else str(Path(renderer).resolve()) if renderer.endswith(".onnx") else renderer,
        mode=mode or (DEFAULT_MODE if matte is None else "between"),
        camera=None if camera is None else CameraFile.of_clip(camera.resolve(), source.info),
        focus=None if focus_pull is None else FocusPulled.of(focus_pull),
        depth=None if depth is None else DepthFiles(depth.resolve(), steady_depth),
        matte=None if matte is None else MatteFiles(matte.resolve()),
        near_m=near_distance,
        look=None if wanted == LookOptions(seed=seed) else ClipLook(wanted, clip.resolve(), rate, start),
        first_number=number,
        virtual_only=virtual_only,
    )
    target = _target(out.resolve(), encoding, source, number, virtual_only)
    shot = Shot(source, recipe, target, start, stop, max(1, round(segment * source.info.frame_rate)))
    target.require_new(shot, overwrite or shot.was_begun)
    _try_first_frame(shot)
    note = _made(shot, _crew(cluster, workers, len(shot.segments)), overwrite)
    typer.echo(f"wrote {out} ({source.info.width_px}x{source.info.height_px} px, {stop - start} frames, {note})")


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


def _range(frames: str, source: PictureSource) -> tuple[int, int]:
    (start, stop), count = parse_frames(frames), len(source.times_s)
    if start >= count:
        raise InputError(f"--frames {frames} leaves nothing of {source.path}: expected a range within its {count} frames")
    return start, min(count, count if stop is None else stop)


def _target(out: Path, encoding: str | None, source: PictureSource, number: int, virtual_only: bool) -> Target:
    if is_pattern(out):
        if encoding is not None:
            raise InputError(f"--encoding {encoding} is for videos, but {out} are pictures: leave it out")
        return SequenceTarget(out, number, virtual_only)
    if virtual_only:
        encoding = encoding or "prores4444-alpha"
    return VideoTarget(out, encoding, None if is_pattern(source.path) else source.path)


def _crew(cluster: str | None, workers: int, segments: int) -> Crew:
    if cluster is not None:
        return DaskCrew(cluster)
    count = min(workers or cores(), segments)
    return OneProcess() if count == 1 else ProcessCrew(count)


def _try_first_frame(shot: Shot) -> None:
    """Mistakes in files and options are told at once, and not by a worker."""
    frame = next(shot.source.frames(shot.start, shot.start + 1))
    shot.recipe.build(1).make(shot.start, frame.rgb, frame.time_s)


def _made(shot: Shot, crew: Crew, overwrite: bool) -> str:
    with progress_bars() as bars:
        task = bars.add_task("compositing", total=shot.stop - shot.start)
        try:
            return make_shot(shot, crew, overwrite=overwrite, progress=lambda count: bars.advance(task, count))
        except KeyboardInterrupt:
            typer.echo(f"interrupted: finished segments wait in {shot.parts_path}; the same command goes on from there", err=True)
            raise typer.Exit(INTERRUPTED) from None
