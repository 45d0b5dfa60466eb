"""`mrbokeh capture depth`: dense metric depth from neighbouring views and focus, and the all-in-focus picture made with it."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, tell, warn

HELP = "\n\n".join(
    (
        "Find dense depth in metres for every stack that has a pose, from neighbouring views and focus together, and make its "
        "all-in-focus picture again with it: no rings around lights, for this depth does not come from blur.",
        "Needs `mrbokeh capture poses` and `scale`. The first picture and depth are kept in first_pass/; finished stacks are left "
        "alone unless --overwrite is given. Stacks without a pose keep their depth from focus.",
        "Of plain photographs (the folder of `capture poses --images`), it writes depth/NAME.exr for each, in metres where the scale is "
        "known; clips get theirs by `mrbokeh video --depth auto`.",
        "Example:  mrbokeh capture depth scene/",
        "Example:  mrbokeh capture depth reconstruction/",
    )
)


def depth_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder of `mrbokeh capture scale`, or of `capture poses --images`")],
    neighbours: Annotated[int | None, typer.Option(min=1, help="how many other views each stack is compared with; default: 6")] = None,
    device: Annotated[
        str | None, typer.Option(metavar="cuda|cpu", help="of torch, for the plane sweep; without it compiled loops run")
    ] = None,
    patch_match: Annotated[
        bool, typer.Option("--patch-match", help="narrow the sweep by COLMAP's PatchMatch (pycolmap-cuda12 and an NVIDIA GPU)")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="find depth again where it is there already")] = False,
) -> None:
    from capture.dense.picture_depth import is_reconstruction
    from capture.dense.scene_depth import SceneDepthSettings, deepen_scene
    from capture.merging.retouch import retouched_stacks, retouches_text, stacks_before
    from mrbokeh.depth.views.dense_depth import DenseSettings
    from mrbokeh.figures.stack_pictures import SHEET_NAME
    from mrbokeh.system.console import kept_when_interrupted

    if is_reconstruction(scene):
        if patch_match or neighbours is not None:
            raise InputError(f"{scene} holds poses of plain pictures: --patch-match and --neighbours are for stacks, leave them out")
        _pictures(scene, overwrite, device)
        return
    retouched = retouched_stacks(stacks_before(scene))
    settings = SceneDepthSettings(neighbours or 6, overwrite, patch_match, DenseSettings(device=device))
    with kept_when_interrupted(f"finished stacks are kept in {scene}", overwrite):
        result = deepen_scene(scene, settings)
    for stack in result.stacks:
        tell(f"{stack.folder}: depth.exr (metres, {stack.depth_valid().mean():.0%} trusted), all_in_focus.exr, {SHEET_NAME}")
        if stack.folder in retouched and not retouches_text(stack):
            warn(
                f"{stack.folder}: its retouches ({retouched[stack.folder]}) stay at most where depth is not trusted: "
                "look at the picture, and give --from-slice and --mask to `capture merge` again where they are gone"
            )
    if result.left_out:
        say(f"without a pose or with guessed metres, depth from focus only: {', '.join(result.left_out)}")


def _pictures(folder: Path, overwrite: bool, device: str | None) -> None:
    """Find the depth of plain pictures."""
    from capture.dense.picture_depth import deepen_pictures
    from mrbokeh.system.console import kept_when_interrupted

    with kept_when_interrupted(f"finished depth is kept in {folder}", overwrite):
        done = deepen_pictures(folder, overwrite=overwrite, device=device)
    unit = "metres" if done.metric else "the unit of the poses, whose metres nobody knows"
    tell(f"{done.folder}: depth of {len(done.names)} pictures (Z in {unit}, confidence), and pictures of it", pictures=len(done.names))
