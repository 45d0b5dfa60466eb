"""`mrbokeh capture dataset`: merged stacks as a data set with manifest, hashes, split and exclusion masks."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, tell, warn

if TYPE_CHECKING:
    from mrbokeh.stacks.focal_stack_dataset import FocalStackDataset

HELP = "\n\n".join(
    (
        "Write a data set for training: stacks with all-in-focus picture, depth and exclusion masks, and dataset.json with the hash of "
        "every file, the split by viewpoint, the radiance scale, the largest circle of confusion and the network's size N.",
        "Files are hard links where the disk allows it. An interrupted run goes on where it stopped. Nothing is overwritten unless asked.",
        "Example:  mrbokeh capture dataset scene_a/ scene_b/ --out lens_50mm/ --licence 'CC BY 4.0, Jane Doe'",
        "Example:  mrbokeh capture dataset scene/ --out lens_50mm/ --licence LICENCE.txt --test view_3 --test view_7",
        "Example:  mrbokeh capture dataset --out lens_50mm/ --verify",
    )
)


def dataset_command(
    out: Annotated[Path, typer.Option(metavar="DATASET", help="folder of the data set")],
    scenes: Annotated[list[Path] | None, typer.Argument(metavar="SCENE...", help="folders with merged stacks")] = None,
    licence: Annotated[str, typer.Option(metavar="TEXT|FILE", help="under which the pictures may be used (required)")] = "",
    test: Annotated[list[str] | None, typer.Option(metavar="VIEW", help="viewpoints to test on, instead of a share of all")] = None,
    test_share: Annotated[float, typer.Option(help="of the viewpoints, chosen by hash")] = 0.2,
    seed: Annotated[int, typer.Option(min=0, help="of that choice")] = 0,
    radiance_scale: Annotated[
        str, typer.Option(metavar="maximum|SHARE|'radiance X'", help="radiance at the upper end of the network's range")
    ] = "maximum",
    coc_maps: Annotated[bool, typer.Option("--coc-maps", help="also write each slice's signed circle of confusion (EXR, half)")] = False,
    copy: Annotated[bool, typer.Option("--copy", help="copy files also where they could be hard links")] = False,
    renderer: Annotated[str, typer.Option(help="that predicts slices, to find what moved")] = "polygon",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="bring a finished data set up to date")] = False,
    verify: Annotated[bool, typer.Option("--verify", help="hash all files of a data set again; exit with 1 where one differs")] = False,
) -> None:
    if verify:
        _verify(out)
        return
    from capture.dataset.stack_writer import StackWriting
    from capture.dataset.writer import DatasetPlan, write_dataset
    from capture.report.stack_view import reblur_by
    from mrbokeh.stacks.guessed_metres import metres_notes
    from mrbokeh.system.console import kept_when_interrupted

    if not scenes:
        raise InputError("expected the folders of scenes, got none: mrbokeh capture dataset SCENE... --out DATASET --licence TEXT")
    writing = StackWriting(copy, coc_maps, reblur_by(renderer))
    plan = DatasetPlan(
        licence=licence_text(licence),
        test=tuple(test or ()),
        test_share=test_share,
        seed=seed,
        radiance_scale=radiance_scale,
        writing=writing,
    )
    with kept_when_interrupted(f"finished stacks are kept in {out}", overwrite):
        dataset = write_dataset(scenes, out, plan, overwrite)
    train, held_out = len(dataset.records("train")), len(dataset.records("test"))
    tell(
        f"{out}: {train} stacks to train on, {held_out} to test on{_slices_held_out(dataset)}; "
        f"largest circle of confusion {dataset.largest_coc_px:.1f} px "
        f"(N = {dataset.network_blocks}), radiance scale {dataset.radiance_scale:.4g}",
        stacks_to_train=train,
        stacks_to_test=held_out,
        largest_coc_px=dataset.largest_coc_px,
    )
    if note := metres_notes([*dataset.focal_stacks("train"), *dataset.focal_stacks("test")]):
        guess(note)


def _slices_held_out(dataset: "FocalStackDataset") -> str:
    """Say what a data set of one stack is tested on."""
    if len(dataset.stacks) > 1:
        return ""
    slices = ", ".join(str(index) for index in dataset.stacks[0].held_out_slices)
    return f" but slices {slices}, held out of one stack, not an unseen view" if slices else "; no slice is held out either"


def licence_text(text_or_file: str) -> str:
    """Return the text of a file where there is one of that name, else the text itself."""
    path = Path(text_or_file)
    try:
        return path.read_text(encoding="utf-8") if text_or_file and path.is_file() else text_or_file
    except OSError:  # a long text is no name of a file
        return text_or_file


def _verify(out: Path) -> None:
    from capture.dataset.writer import verify
    from mrbokeh.stacks.focal_stack_dataset import read_focal_stack_dataset

    dataset = read_focal_stack_dataset(out)
    troubles = verify(dataset)
    for each in troubles:
        warn(each)
    files = sum(len(each.files) for each in dataset.stacks)
    tell(f"{out}: {files} files, {len(troubles)} wrong")
    if troubles:
        raise typer.Exit(1)
