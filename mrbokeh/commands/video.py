"""`mrbokeh video`: virtual objects in every frame of a clip, blurred by its lens."""

from pathlib import Path

import typer

from mrbokeh.commands import _video_options as options
from mrbokeh.commands._insertion_options import ColourOptions, VirtualOptions
from mrbokeh.commands._look_options import LookGroup
from mrbokeh.commands._option_groups import grouped
from mrbokeh.commands._video_shot import parse_frames as parse_frames
from mrbokeh.commands._video_shot import recipe_of, shot_of, target_of
from mrbokeh.shots.crew import Crew, OneProcess
from mrbokeh.shots.dask_crew import DaskCrew
from mrbokeh.shots.making import make_shot
from mrbokeh.shots.process_crew import ProcessCrew
from mrbokeh.shots.shot import Shot, Target
from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.console import kept_when_interrupted, progress_bars
from mrbokeh.system.resources import cores
from mrbokeh.video.clip import has_alpha_apart
from mrbokeh.video.picture_sources.base import PictureSource
from mrbokeh.video.picture_sources.choose import open_source

app = typer.Typer(add_completion=False)


@app.command()
@grouped
def video(
    clip: options.ClipArgument,
    taken: options.ClipOptions,
    virtual: VirtualOptions,
    rendering: options.RenderingOptions,
    look: LookGroup,
    lens: options.LensOption,
    blur: options.BlurOptions,
    out: options.OutOption,
    colour: ColourOptions,
    result: options.ResultOptions,
    work: options.WorkOptions,
) -> None:
    """Blur virtual layers with the lens and put them into each frame in linear light; sound and times are kept.

    Finished segments wait in OUT.parts: the same command goes on where it was interrupted.

    Example: mrbokeh video clip.mp4 --layer lantern.exr --lens lens.json --out lantern_in_clip.mov --frames 0:50

    Example: mrbokeh video clip.mov --scene scene.toml --camera track.json --focus-pull 0:1.2,48:3.5 --lens lens.json --out out.mp4
    """
    require_safe_outputs((out,), (clip, taken.depth, taken.matte, *virtual.files, rendering.distortion, lens), overwrite=True)
    source = open_source(clip, taken.rate, colour.of_plate)
    recipe = recipe_of(source, lens, taken, virtual, rendering, look, blur, virtual_only=result.virtual_only)
    target = target_of(out, source, recipe, colour, result)
    shot = shot_of(source, recipe, target, taken.frames, work.segment)
    target.require_new(shot, result.overwrite or shot.was_begun)
    _try_first_frame(shot)
    if not result.virtual_only and (lost := _alpha_lost(clip, source, target)):
        typer.echo(f"warning: {clip} {lost}", err=True)
    note = _made(shot, _crew(work, len(shot.segments)), result.overwrite)
    frames = shot.stop - shot.start
    typer.echo(f"wrote {out} ({source.info.width_px}x{source.info.height_px} px, {frames} frame{'' if frames == 1 else 's'}, {note})")


def _alpha_lost(clip: Path, source: PictureSource, target: Target) -> str | None:
    """What to tell of the clip where its alpha is not read, or cannot be kept."""
    if source.info.has_alpha:
        return target.lacks_alpha and f"has alpha, but {target.lacks_alpha}: what it does not cover is black in {target.path.name}"
    if source.file_of(0) is None and has_alpha_apart(clip):
        return "keeps its alpha apart (VP8, VP9), where it is not read: it is taken as opaque; turn it into ProRes 4444 or FFV1 before"
    return None


def _crew(work: options.WorkOptions, segments: int) -> Crew:
    if work.cluster is not None:
        return DaskCrew(work.cluster)
    count = min(work.workers or cores(), segments)
    return OneProcess() if count == 1 else ProcessCrew(count)


def _try_first_frame(shot: Shot) -> None:
    """Mistakes in files and options are told at once, and not by a worker."""
    frame = next(shot.source.frames(shot.start, shot.start + 1))
    shot.recipe.build(1).make(shot.start, frame.rgb, frame.time_s, frame.alpha)


def _made(shot: Shot, crew: Crew, overwrite: bool) -> str:
    with kept_when_interrupted(f"finished segments are kept in {shot.parts_path}"), progress_bars() as bars:
        task = bars.add_task("compositing", total=shot.stop - shot.start)
        return make_shot(shot, crew, overwrite=overwrite, progress=lambda count: bars.advance(task, count))
