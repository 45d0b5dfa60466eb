"""The command `mrbokeh train fit`."""

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import channel, guess, say, tell
from training.fitting.settings import with_overrides

Scenes = Annotated[
    list[Path],
    typer.Argument(help="A data set (of `mrbokeh capture dataset`), folders of merged focal stacks or of blur pairs, or folders of such."),
]


if TYPE_CHECKING:
    from training.fitting.checkpoint import Progress
    from training.fitting.settings import TrainSettings


class Preset(StrEnum):
    paper = "paper"
    demo = "demo"
    better = "better"


def fit_command(
    scenes: Scenes,
    out: Annotated[Path, typer.Option(help="Folder of the run: settings, checkpoint, curve, network.")],
    preset: Annotated[
        Preset | None,
        typer.Option(
            help="paper (default): as published; demo: our gated form, learns in minutes on two cores; better: kernels by place and colour."
        ),
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.01, max=100_000.0, help="Budget in minutes; the learning rate follows it.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Budget in epochs, instead of minutes.")] = None,
    held_out: Annotated[
        list[str] | None,
        typer.Option(
            help="Stack to keep for testing (repeat for more), instead of the split of the data set; of scenes else a fifth is drawn."
        ),
    ] = None,
    tune: Annotated[
        Path | None,
        typer.Option(
            "--tune",
            help="A finished run to go on from, with other pictures of its lens and its own settings, for 5 minutes.",
        ),
    ] = None,
    settings_file: Annotated[Path | None, typer.Option("--settings", help="A settings.json to start from instead of a preset.")] = None,
    choices: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any setting of settings.json (repeat for more), as in batch=4 or network.tile_px=96; none for no value.",
        ),
    ] = None,
    threads: Annotated[int | None, typer.Option(min=0, max=4096, help="CPU threads, 0 takes all.")] = None,
    device: Annotated[str | None, typer.Option(help="auto, cpu or cuda.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of weights and batches.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start again where a run exists.")] = False,
) -> None:
    """Train a network on focal stacks; run again after an interruption and it goes on where it stopped.

    A data set brings its split by viewpoint, its radiance scale and its largest circle of confusion, which decides the network's N.
    Of a single stack every fourth slice or so, inside its focus range, is held out; `mrbokeh train evaluate` judges on these.
    A budget in minutes that has no time for 200 steps is refused after the first ones, before anything is written.
    OUT/index.html shows curves and held-out slices as they come along.
    Pixels that moved, have no data, show a calibration board, are saturated or have no trustworthy depth do not count.

    On several GPUs or machines torchrun starts it: every process takes its own pictures, `batch` of them a step. After an interruption it
    may go on with another number of processes: through the same pictures in the same order, but so many fewer or more a step.

    Example: mrbokeh train fit lens_50mm --out runs/50mm

    Example: mrbokeh train fit scenes/attic --preset demo --minutes 2.5 --held-out view_3 --out runs/attic

    Example: mrbokeh train fit more_views --tune runs/50mm --out runs/more

    Example: mrbokeh train fit lens_50mm --set network.tile_px=96 --set network.overlap_px=24 --set loss_scope=tile --out runs/tiles

    Example: torchrun --nproc-per-node 4 -m training fit lens_50mm --set precision=bfloat16 --out runs/50mm
    """
    from mrbokeh.stacks.focal_stack import require_folder

    # Threads that wait for one another in a busy loop make training many times slower as soon as anything else uses a core.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read by OpenMP when torch is loaded, in the next lines
    budget: dict[str, Any] = {"minutes": minutes, "epochs": epochs} if minutes is not None or epochs is not None else {}
    given = {"threads": threads, "device": device, "seed": seed}
    try:
        settings = with_overrides(_begun_with(preset, settings_file, tune, choices or (), out, overwrite), choices or ())
        settings = replace(settings, **budget | {name: value for name, value in given.items() if value is not None})
        for scene in scenes:
            require_folder(scene)
        if _number("RANK") == 0:
            _require_run(out)
            say(f"reading {', '.join(str(scene) for scene in scenes)}", err=True)  # loading PyTorch takes seconds
        _fit(scenes, out, settings, held_out or [], overwrite, tune)
    except InputError:
        if _number("LOCAL_RANK"):  # one sentence for each machine
            raise typer.Exit(2) from None
        raise


def _fit(scenes: list[Path], out: Path, settings: "TrainSettings", held_out: list[str], overwrite: bool, tune: Path | None) -> None:
    from mrbokeh.stacks.focal_stack import FocalStack
    from mrbokeh.stacks.guessed_metres import metres_notes
    from training.data.training_data import training_data
    from training.fitting.run import StoppedError
    from training.fitting.train import fit

    code = 0
    try:
        data = training_data(scenes)
        if _number("RANK") == 0:
            say(data.split(held_out, settings.test_fraction, settings.seed).words(), err=True)
            if note := metres_notes(stack for stack in data.stacks if isinstance(stack, FocalStack)):
                guess(note)
        said = f"{out}: {_summary(fit(data, out, settings, held_out, overwrite, start_from=tune))}"
    except StoppedError as stop:
        code, channel().kept = stop.exit_code, str(stop)
    except KeyboardInterrupt:
        code, channel().kept = 130, "stopped at once; the same command goes on from the last checkpoint, if there is one"
    if _number("RANK") == 0 and code == 0:
        tell(said)
    raise typer.Exit(code)


def _summary(progress: "Progress") -> str:
    looks = [point.held_out_psnr_db for point in progress.curve if not math.isnan(point.held_out_psnr_db)]
    said = f"{progress.step} steps in {progress.elapsed_s:.0f} s, loss {progress.smoothed_loss:.2e}"
    if looks:
        said += f", held-out slices {looks[-1]:.2f} dB"
    if looks and not math.isnan(progress.sharp_psnr_db):
        said += f" (without any blur {progress.sharp_psnr_db:.2f} dB)"
    if progress.stopped_early:
        said += f"; stopped early: no improvement in the last {progress.looks_since_best} evaluations"
    if looks and progress.kept_step != progress.step:
        said += f"; kept the weights of step {progress.kept_step}, {progress.best_psnr_db:.2f} dB"
    return said


def _number(name: str) -> int:
    """Return a number of this process, as torchrun tells it: RANK among all, LOCAL_RANK on its machine."""
    return int(os.environ.get(name, "0"))


def _begun_with(
    preset: Preset | None, settings_file: Path | None, tune: Path | None, choices: Sequence[str], out: Path, overwrite: bool
) -> "TrainSettings":
    from training.fitting.checkpoint import FILE_NAME as CHECKPOINT_NAME
    from training.fitting.run_folder import read_facts
    from training.fitting.settings import FILE_NAME, PRESETS, load_settings, tuned_settings

    if tune is None:
        return PRESETS[preset or Preset.paper]() if settings_file is None else load_settings(settings_file)
    kept = [each for each in choices if each.startswith(("network.", "radiance_scale"))]
    if preset is not None or settings_file is not None or kept:
        which = kept[0] if kept else "--preset or --settings"
        raise InputError(f"--tune takes the network and its ranges from {tune}, got {which} beside it: leave that out")
    if not overwrite and (out / CHECKPOINT_NAME).exists():
        return load_settings(out / FILE_NAME)
    return tuned_settings(tune, is_tuned=bool(read_facts(tune).tuned_from))


def _require_run(out: Path) -> None:
    """Refuse a folder that is neither new, nor empty, nor that of a run."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: expected a folder, but {out} is a file")
    if out.is_dir() and not (out / "settings.json").exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty and holds no training run: give another --out")
