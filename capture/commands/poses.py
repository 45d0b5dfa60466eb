"""`mrbokeh capture poses`: where the cameras stood."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import tell, warn

HELP = "\n\n".join(
    (
        "Find the camera poses of all stacks of a scene from their all-in-focus pictures, with COLMAP (SIFT, exhaustive matching).",
        "Writes SCENE/reconstruction: poses.json and points.npz in COLMAP's own unit (`mrbokeh capture scale` finds metres), beside "
        "COLMAP's own files. Viewpoints whose reference slices share the focus share a camera. An interrupted run goes on with the "
        "stage that it was in; finished poses are kept.",
        "Example:  mrbokeh capture poses scene/",
        "Example:  mrbokeh capture poses --images photographs/ --out reconstruction/",
    )
)


def poses_command(
    scene: Annotated[Path | None, typer.Argument(metavar="SCENE", help="folder with merged stacks")] = None,
    images: Annotated[Path | None, typer.Option(metavar="DIR", help="a folder of plain pictures instead of a scene")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="with --images: where the reconstruction goes")] = None,
    mapper: Annotated[str, typer.Option(help="incremental, or global (GLOMAP)")] = "incremental",
    camera_model: Annotated[
        str, typer.Option(help="RADIAL (two terms of distortion), SIMPLE_RADIAL (one), or auto: two for a camera of 5 pictures or more")
    ] = "auto",
    cameras: Annotated[str, typer.Option(help="auto, shared (one for all pictures) or separate (one each)")] = "auto",
    max_image_size: Annotated[int, typer.Option(min=200, metavar="PX", help="features are sought in pictures no wider or higher")] = 1600,
    seed: Annotated[int, typer.Option(min=0, help="of COLMAP's random draws")] = 0,
    threads: Annotated[int, typer.Option(min=0, max=4096, help="for features and matches; 0 takes all cores")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="find poses again from the start")] = False,
) -> None:
    from capture.poses.colmap import PoseSettings, find_picture_poses, find_scene_poses
    from capture.poses.colmap_matches import median_parallax_deg
    from mrbokeh.system.console import kept_when_interrupted

    settings = PoseSettings(
        mapper=mapper,
        camera_model=camera_model,
        cameras=cameras,
        max_image_size_px=max_image_size,
        seed=seed,
        threads=threads or -1,
        overwrite=overwrite,
    )
    if scene is not None and images is None and out is None:
        where, find = scene / "reconstruction", partial(find_scene_poses, scene)
    elif scene is None and images is not None and out is not None:
        where, find = out, partial(find_picture_poses, images, out)
    else:
        raise InputError("expected either a SCENE, or --images DIR together with --out DIR: see `mrbokeh capture poses --help`")
    with kept_when_interrupted(f"COLMAP's finished stages are kept in {where}", overwrite):
        model = find(settings)
    placed, total = len(model.views), len(model.views) + len(model.left_out)
    tell(
        f"{where}: {placed} of {total} viewpoints placed, {len(model.points)} points, reprojection error "
        f"{model.errors_px.mean():.2f} px, median parallax {median_parallax_deg(model):.1f} degrees",
        viewpoints_placed=placed,
        viewpoints=total,
        error_px=float(model.errors_px.mean()),
    )
    if model.left_out:
        warn(f"left out, for they do not connect to the others: {', '.join(model.left_out)}")
