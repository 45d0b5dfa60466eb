"""`mrbokeh dataset synthesize`: focal stacks computed from a folder of pictures with depth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.commands._insertion_options import ANY_LENS, ANY_RENDERER, DisparityOption, ExactDepthOption, LensFacts, OverwriteOption
from mrbokeh.commands._option_groups import grouped
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import tell, warn

app = typer.Typer(no_args_is_help=True, help="Data sets for research: focal stacks from pictures with depth.")


@app.callback()
def dataset() -> None:
    """Make data sets."""


@dataclass(frozen=True)
class DepthOptions:
    """Meaning of the depth files."""

    disparity: DisparityOption = None
    depth_scale: Annotated[float | None, typer.Option(help="Depth files hold distance: metres for each step; 0 is unknown.")] = None
    stereo: Annotated[
        str | None, typer.Option("--stereo-cameras", metavar="FOCAL_PX,BASELINE_M,OFFSET_PX", help="Cameras of a disparity file.")
    ] = None
    exact_depth: ExactDepthOption = False


@dataclass(frozen=True)
class SetOptions:
    """Slices of each sample, and the form of the set."""

    slices: Annotated[int, typer.Option(min=2, max=1000, help="Slices of each picture, evenly in dioptres over its depth.")] = 10
    focus: Annotated[str | None, typer.Option(help="Distances for all in place of that: 0.8,1.2,inf or FROM:TO:COUNT.")] = None
    format: Annotated[str, typer.Option(help="folders (focal stacks), webdataset (.tar) or hdf5 (.h5).")] = "folders"
    renderer: Annotated[str | None, typer.Option("--renderer", help=ANY_RENDERER)] = None
    workers: Annotated[int, typer.Option(min=0, help="Processes on this machine; 0 takes one for each core.")] = 0
    overwrite: OverwriteOption = False


@app.command()
@grouped
def synthesize(
    rgbd: Annotated[
        Path,
        typer.Argument(
            metavar="RGBD", help="Folder of rgb/NAME.png with depth/NAME.exr, of NAME.png with NAME_depth.exr, or of merged focal stacks."
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="SET", help="Folder of the set.")],
    depth: DepthOptions,
    facts: LensFacts,
    wanted: SetOptions,
    lens: Annotated[Path | None, typer.Option(help=f"{ANY_LENS}. Default: 50 mm f/1.8.")] = None,
) -> None:
    """Blur every picture of a folder at several focus distances: slices, all-in-focus picture, depth, diameters of blur, and their facts.

    The same bytes come from any number of workers; a run that was stopped goes on.

    Example: mrbokeh dataset synthesize rgbd/ --lens double-gauss-50 --disparity 0.5:8 --out set/
    """
    from mrbokeh.depth.depth_map import DepthSettings, parse_near_far, parse_stereo
    from mrbokeh.optics.lens import Lens
    from mrbokeh.renderers.choose import lens_and_renderer
    from mrbokeh.shots.synthesis import FORMATS, RECORD, Synthesis, remove_set, sources_in
    from mrbokeh.shots.synthesis import synthesize as make
    from mrbokeh.stacks.focus_places import FocusLookup, parse_focus
    from mrbokeh.system.console import kept_when_interrupted
    from mrbokeh.system.resources import cores

    if wanted.format not in FORMATS:
        raise InputError(f"--format must be one of {', '.join(FORMATS)}, got {wanted.format!r}")
    facts.on(*lens_and_renderer(lens, wanted.renderer))
    sources, alone = sources_in(rgbd)
    if wanted.focus is not None and not set("@#") & set(wanted.focus):
        parse_focus(wanted.focus, FocusLookup(Lens.default()))
    settings = Synthesis(
        lens=None if lens is None else lens.resolve() if lens.exists() else lens,
        facts=tuple(facts.given.items()),
        renderer=wanted.renderer,
        depth=DepthSettings(
            near_far_m=None if depth.disparity is None else parse_near_far(depth.disparity),
            metres_per_unit=depth.depth_scale,
            stereo=None if depth.stereo is None else parse_stereo(depth.stereo),
            exact=depth.exact_depth,
        ),
        focus=wanted.focus,
        slices=wanted.slices,
        format=wanted.format,
    )
    if wanted.overwrite and (out / RECORD).exists():
        remove_set(out)
    with kept_when_interrupted(f"finished samples are kept in {out}", wanted.overwrite):
        made, failed = make(sources, rgbd, out, settings, wanted.workers or cores())
    for name, why in failed.items():
        warn(f"left out {name}: {why}")
    if alone:
        warn(f"left out for want of a partner: {', '.join(alone[:8])}{', ...' if len(alone) > 8 else ''}")
    tell(f"{out}: {made} samples ({wanted.format})", samples=made, left_out=sorted(failed))
