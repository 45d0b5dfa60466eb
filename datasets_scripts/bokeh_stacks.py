"""Ray-traced focal stacks with a known lens, to train on: heart, ring, bladed and round bokeh (Mandl et al. 2024, section 4.1).

    python -m datasets_scripts.bokeh_stacks OUT --shape heart [--size small|full --pull 48]
    mrbokeh train fit OUT --out RUN

OUT is a data set with a manifest (`mrbokeh.stacks.focal_stack_dataset`): OUT/SCENE/view_NN/ are focal stacks with all-in-focus picture and
depth, OUT/lens.json is the lens. Finished files are kept, so an interrupted run goes on where it stopped; `--scenes` gives machines a
share of the work each. With --pull OUT.pull/ becomes one test view at many focus distances, to see whether blur changes smoothly.
It needs Mitsuba 3 (`pip install 'mrbokeh[datasets]'`) and LLVM's library (Debian: libllvm19).
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from datasets_scripts.made_sets.bokeh_plan import SHAPES, SIZES, StacksPlan
from datasets_scripts.made_sets.bokeh_view import StackView, dataset_of
from datasets_scripts.made_sets.set_files import LICENCE, claim_folder
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.scene.mitsuba.mitsuba_tracer import load
from mrbokeh.stacks.focal_stack_dataset import FILE_NAME, FocalStackDataset, write_focal_stack_dataset
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

PLAN_NAME = "plan.json"


def make_bokeh_stacks(out: Path, plan: StacksPlan, only: tuple[str, ...] = (), *, overwrite: bool = False) -> FocalStackDataset | None:
    """Write what is missing of a set, the manifest last. Return the set, or None where only some scenes were asked for.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    _require_scenes(plan, only)
    load()
    views = [StackView(out / name, plan, *_place(name)) for name in plan.names]
    claim(out, plan, views, overwrite)
    write_lens(out / "lens.json", plan.lens(plan.focus_distances_m[0]))
    _make_missing([view for view, name in zip(views, plan.names, strict=True) if not only or _place(name)[0] in only], "tracing stacks")
    if not all(job.done for view in views for job in view.jobs()):
        return None
    dataset = dataset_of(out, plan)
    (out / "LICENCE.txt").write_text(LICENCE + "\n", encoding="utf-8")
    write_focal_stack_dataset(dataset)
    return dataset


def make_pull(out: Path, plan: StacksPlan, frames: int, *, overwrite: bool = False) -> Path:
    """Trace a test view in so many focus steps, evenly in dioptres, from the second to the last but one distance; return its folder."""
    if frames < 2:
        raise InputError(f"a focus pull needs at least 2 frames, got {frames}")
    name = next(name for name, part in plan.parts().items() if part == "test")
    inner = plan.focus_distances_m[1:-1] or plan.focus_distances_m
    distances_m = tuple(float(each) for each in 1.0 / np.linspace(1.0 / inner[0], 1.0 / inner[-1], frames))
    view = StackView(out / name, plan, *_place(name), distances_m)
    claim(out, plan, [view], overwrite, {"pull_frames": frames})
    _make_missing([view], "tracing a focus pull")
    return out / name


def claim(out: Path, plan: StacksPlan, views: list[StackView], overwrite: bool, more: dict[str, int] | None = None) -> None:
    """Go on only in a folder that is empty or was begun with the same plan: plan.json, written first, says which."""
    path = out / PLAN_NAME
    if not overwrite and not path.exists() and out.exists() and any(out.iterdir()):
        raise InputError(f"{out} holds something else than a set of bokeh stacks: give the name of a new folder")
    files = [each for view in views for job in view.jobs() for each in job.paths]
    claim_folder(path, _plan_document(plan) | (more or {}), files, overwrite)
    if overwrite:
        (out / FILE_NAME).unlink(missing_ok=True)


def _make_missing(views: list[StackView], description: str) -> None:
    for job in track([job for view in views for job in view.jobs() if not job.done], description):
        job.make()


def _plan_document(plan: StacksPlan) -> dict[str, object]:
    document = asdict(plan)
    return document | {"size": document["size"] | {"scenes": list(plan.size.scenes)}}


def _place(name: str) -> tuple[str, int]:
    scene, view = name.split("/view_")
    return scene, int(view)


def _require_scenes(plan: StacksPlan, only: tuple[str, ...]) -> None:
    unknown = set(only) - set(plan.size.scenes)
    if unknown:
        raise InputError(f"expected scenes out of {', '.join(plan.size.scenes)}, got {', '.join(sorted(unknown))}")


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the set.")],
    shape: Annotated[str, typer.Option(help=f"Opening of the lens: {', '.join(SHAPES)}.")],
    size: Annotated[str, typer.Option(help=f"{' or '.join(SIZES)}; docs/datasets.md says how long they take.")] = "small",
    scenes: Annotated[str, typer.Option(help="Only these, with commas between: a share of the work.")] = "",
    samples: Annotated[int, typer.Option(help="Camera rays per pixel, 0 for those of the size.")] = 0,
    pull: Annotated[int, typer.Option(help="Also OUT.pull: one test view at so many focus distances.")] = 0,
    seed: Annotated[int, typer.Option(help="Viewpoints and sampling; scenes are numbered.")] = 1,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a set made with other settings.")] = False,
) -> None:
    """Trace the missing pictures of a set of focal stacks."""
    try:
        if size not in SIZES:
            raise InputError(f"expected a size out of {', '.join(SIZES)}, got {size!r}")
        chosen = replace(SIZES[size], samples=samples) if samples else SIZES[size]
        plan = StacksPlan(shape, chosen, seed)
        dataset = make_bokeh_stacks(out, plan, tuple(scenes.split(",")) if scenes else (), overwrite=overwrite)
        if pull:
            typer.echo(f"{make_pull(out.with_name(out.name + '.pull'), plan, pull, overwrite=overwrite)}: focus pull complete")
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out}: " + ("other scenes are missing still" if dataset is None else _summary(dataset)))


def _summary(dataset: FocalStackDataset) -> str:
    floor = dataset.metadata["noise_floor_db"]
    return (
        f"{len(dataset.stacks)} stacks, largest circle of confusion {dataset.largest_coc_px:.1f} px, radiance up to "
        f"{dataset.radiance_scale:.1f}, noise floor {floor['lowest']:.1f} dB at worst, {floor['median']:.1f} dB in the middle"
    )


if __name__ == "__main__":
    typer.run(main)
