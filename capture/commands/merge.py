"""`mrbokeh capture merge`: registered slices, all-in-focus picture and depth of every stack."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, say, tell

if TYPE_CHECKING:
    from mrbokeh.stacks.focal_stack import FocalStack

HELP = "\n\n".join(
    (
        "Register the slices of every stack, merge an all-in-focus picture and find depth from focus. Other commands read "
        "all_in_focus.exr and depth.exr; for people there are all_in_focus.png, all_in_focus.tif (16 bits), all_in_focus.dng (of RAW, "
        "linear) and depth.png (near is red, far is blue, grey is a guess), turned upright where the camera says how.",
        "Stacks that are merged already are left alone unless --overwrite is given; an interrupted run goes on where it stopped. "
        "registration.json in the folder of each stack says how its slices fit together. --registration uses such a file for all "
        "stacks instead: those taken with the same lens and the same focus distances from a firm tripod.",
        "--from-slice K --mask FILE retouches a stack that is merged: where the mask is white, picture and depth become those of slice K, "
        "and nothing is registered or merged anew. Slices count from 0, as in merge.png and stack.json; paint the mask over "
        "all_in_focus.png (PNG, TIFF or EXR; grey blends). Both may be given several times, in pairs, and later calls add to earlier ones.",
        "--prefer near (or far) decides where two things at different depths are both seen sharp in one place: a web before leaves, legs "
        "that cross, a scratch on glass. Elsewhere nothing changes.",
        "Example:  mrbokeh capture merge scene/",
        "Example:  mrbokeh capture merge scene/ --registration scene/view_0/registration.json --overwrite",
        "Example:  mrbokeh capture merge scene/ --prefer near --overwrite",
        "Example:  mrbokeh capture merge scene/view_0 --from-slice 3 --mask web.png --from-slice 11 --mask leaves.png",
    )
)


def merge_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder with stacks that `mrbokeh capture ingest` made")],
    registration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="a registration.json to use for every stack instead of finding one")
    ] = None,
    prefer: Annotated[
        Literal["near", "far"] | None,
        typer.Option(help="where a near and a far thing are both seen sharp in one place, as a web before leaves, show this one"),
    ] = None,
    from_slice: Annotated[
        list[int] | None, typer.Option(metavar="K", help="slice to put where the --mask after it is white; may be repeated")
    ] = None,
    mask: Annotated[list[Path] | None, typer.Option(metavar="FILE", help="white where the --from-slice before it is to be taken")] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="merge again what is merged already; retouches and what was told to `scale` are dropped")
    ] = False,
) -> None:
    if from_slice or mask:
        if overwrite or registration is not None or prefer is not None:
            raise InputError(
                "--from-slice and --mask retouch what is merged: leave out --overwrite, --registration and --prefer, or merge first"
            )
        _tell_of_report([_retouch(scene, from_slice or [], mask or [])])
        return
    _tell_of_report(merge_aloud(scene, registration=registration, prefer=prefer, overwrite=overwrite))


def merge_aloud(
    scene: Path, registration: Path | None = None, prefer: Literal["near", "far"] | None = None, *, overwrite: bool
) -> "list[FocalStack]":
    """Merge the stacks of a scene and tell of those that are new, or of all where none is."""
    from capture.merging.merge import ghosts_text, merge_scene
    from capture.merging.metres.known_metres import scale_options
    from capture.merging.metres.relative_stack import ORDER
    from capture.merging.preferred_side import preferred_lines, preferred_side
    from capture.merging.retouch import retouched_stacks, stacks_before
    from mrbokeh.stacks.guessed_metres import metres_facts, metres_note
    from mrbokeh.system.console import kept_when_interrupted
    from mrbokeh.system.resources import keep_freed_pictures

    keep_freed_pictures()
    before = [each for each in stacks_before(scene) if overwrite or not each.merged]
    retouched, scaled = retouched_stacks(before), {each.folder: scale_options(each) for each in before}
    with kept_when_interrupted(f"finished stacks are kept in {scene}", overwrite):
        stacks = merge_scene(scene, overwrite, registration, prefer)
    new = {each.folder for each in before}
    if not new:
        say(f"all of {scene} was merged before and stays as it is (--overwrite merges it again)")
    for stack in stacks:
        if prefer is not None and preferred_side(stack) != prefer:
            say(f"{stack.folder} was merged before, without --prefer {prefer}: --overwrite merges it again")
        if new and stack.folder not in new:
            continue
        _tell(stack)
        guess(metres_note(stack))
        for told in (ghosts_text(stack), stack.metadata.get(ORDER), metres_facts(stack).get("why") if not metres_note(stack) else None):
            if told:
                say(f"  {told}")
        for line in preferred_lines(stack):
            say(f"  {line}")
        if stack.folder in retouched:
            say(f"  merged anew without its retouches ({retouched[stack.folder]}): give --from-slice and --mask again")
        if told := scaled.get(stack.folder):
            say(f"  merged anew without what was told of it: tell it again by `mrbokeh capture scale {stack.folder} {told}`")
    return stacks


def _tell(stack: "FocalStack") -> None:
    from capture.merging.merged_pictures import readable_names
    from mrbokeh.figures.stack_pictures import SHEET_NAME

    depth = "depth in metres" if stack.metres_known else "depth in guessed metres"
    files = ", ".join([*readable_names(stack), SHEET_NAME])
    tell(f"{stack.folder}: all_in_focus.exr, depth.exr ({depth}), {files}")


def _tell_of_report(stacks: "list[FocalStack]") -> None:
    """Say that a report is older than the pictures; a report lies in the folder of the scene, and a stack may be given alone."""
    from capture.report import HTML_NAME

    for report in {folder / HTML_NAME for stack in stacks for folder in (stack.folder, stack.folder.parent)}:
        if report.is_file() and any(report.stat().st_mtime < stack.all_in_focus_path.stat().st_mtime for stack in stacks):
            say(f"{report} is of pictures from before: run `mrbokeh capture report {report.parent}` again")


def _retouch(scene: Path, slices: list[int], masks: list[Path]) -> "FocalStack":
    from capture.merging.retouch import retouch_scene, retouches_text

    stack = retouch_scene(scene, slices, masks)
    _tell(stack)
    say(f"  retouched: {retouches_text(stack)}")
    return stack
