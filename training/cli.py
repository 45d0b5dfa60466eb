"""`mrbokeh train`: fit, evaluate, export."""

import os
import shutil
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.errors import InputError

if TYPE_CHECKING:
    from training.settings import TrainSettings

app = typer.Typer(no_args_is_help=True, help="Focal stacks become a network that blurs like this very lens.")

Scenes = Annotated[
    list[Path],
    typer.Argument(help="A data set (of `mrbokeh capture dataset`), or folders of merged focal stacks, or folders of such folders."),
]


class Preset(StrEnum):
    paper = "paper"
    demo = "demo"


@app.command()
def fit(
    scenes: Scenes,
    out: Annotated[Path, typer.Option(help="Folder of the run: settings, checkpoint, curve, network.")],
    preset: Annotated[
        Preset, typer.Option(help="paper: as published; demo: our gated form, learns in minutes on two cores.")
    ] = Preset.paper,
    minutes: Annotated[float | None, typer.Option(min=0.01, help="Budget in minutes; the learning rate follows it.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Budget in epochs, instead of minutes.")] = None,
    held_out: Annotated[
        list[str] | None,
        typer.Option(
            help="Stack to keep for testing (repeat for more), instead of the split of the data set; of scenes else a fifth is drawn."
        ),
    ] = None,
    settings_file: Annotated[Path | None, typer.Option("--settings", help="A settings.json to start from instead of a preset.")] = None,
    threads: Annotated[int, typer.Option(help="CPU threads, 0 takes all.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    seed: Annotated[int, typer.Option(help="Of weights and batches.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Start again where a run exists.")] = False,
) -> None:
    """Train a network on focal stacks; run again after an interruption and it goes on where it stopped.

    A data set brings its split by viewpoint, its radiance scale and its largest circle of confusion, which decides the network's N.
    Pixels that moved, have no data, show a calibration board, are saturated or have no trustworthy depth do not count.

    Example: mrbokeh train fit lens_50mm --out runs/50mm

    Example: mrbokeh train fit scenes/attic --preset demo --minutes 2.5 --held-out view_3 --out runs/attic
    """
    # Threads that wait for one another in a busy loop make training many times slower as soon as anything else uses a core.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read by OpenMP when torch is loaded, in the next lines
    from training.train import fit as fit_network
    from training.training_data import training_data

    settings = _settings(preset, settings_file)
    if minutes is not None or epochs is not None:
        settings = replace(settings, minutes=minutes, epochs=epochs)
    settings = replace(settings, threads=threads, device=device, seed=seed)
    if overwrite and out.exists():
        _remove_run(out)
    try:
        progress = fit_network(training_data(scenes), out, settings, held_out or ())
    except KeyboardInterrupt:
        typer.echo(f"stopped; the checkpoint in {out} is kept, run the same command again to go on", err=True)
        raise typer.Exit(130) from None
    typer.echo(f"{out}: {progress.step} steps in {progress.elapsed_s:.0f} s, loss {progress.smoothed_loss:.2e}{_last_psnr(progress.curve)}")


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    out: Annotated[Path, typer.Option(help="The .onnx file to write.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Write the network as ONNX, with its lens inside, after checking that ONNX Runtime agrees with PyTorch.

    Example: mrbokeh train export runs/attic --out attic.onnx
    """
    from mrbokeh.atomic_files import refuse_existing
    from training.export_onnx import export_run

    refuse_existing(out, overwrite)
    exported = export_run(run, out)
    size = f"only {exported.facts.width_px}x{exported.facts.height_px} px" if exported.facts.tiled else "any size"
    typer.echo(f"{out}: ONNX Runtime differs from PyTorch by {exported.difference:.1e}; takes {size}")


@app.command()
def evaluate(
    network: Annotated[Path, typer.Argument(help="Folder of a run, or an exported .onnx.")],
    scenes: Scenes,
    out: Annotated[Path | None, typer.Option(help="Folder for table, numbers and pictures; else the run, or beside the .onnx.")] = None,
    reference: Annotated[bool, typer.Option(help="Also the scatter reference with the aperture of the lens (slow).")] = True,
) -> None:
    """Compare the network with no blur, Gaussians of the right size and the reference on stacks it was not trained on.

    Of a data set these are the viewpoints that the network's run held out, whatever was given as --held-out.

    Example: mrbokeh train evaluate runs/50mm lens_50mm

    Example: mrbokeh train evaluate attic.onnx scenes/attic --out results
    """
    from training import evaluate as evaluation
    from training.blur_functions import blur_of
    from training.training_data import training_data

    blur, trained_on = blur_of(network)
    folder = out or (network if network.is_dir() else network.parent)
    result = evaluation.evaluate(blur, evaluation.unseen(training_data(scenes).stacks, trained_on), folder, reference=reference)
    for name, decibel, similarity in evaluation.table(result):
        typer.echo(f"{name:22s} {decibel:>7s} dB   SSIM {similarity}")
    typer.echo(
        f"network over no blur {result.gain_over_no_blur_db:+.2f} dB, over the better Gaussian {result.gain_over_gaussian_db:+.2f} dB"
    )
    typer.echo(f"written to {folder}: evaluation.md, evaluation.csv, evaluation.png")


def _settings(preset: Preset, settings_file: Path | None) -> "TrainSettings":
    from training.presets import PRESETS
    from training.settings import load_settings

    return PRESETS[preset]() if settings_file is None else load_settings(settings_file)


def _remove_run(out: Path) -> None:
    """Remove an earlier run, and nothing that is not one."""
    if not (out / "settings.json").exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty and holds no training run: give another --out")
    shutil.rmtree(out)


def _last_psnr(curve: list[tuple[int, float, float, float]]) -> str:
    return f", held-out slices {curve[-1][3]:.2f} dB" if curve and curve[-1][3] == curve[-1][3] else ""
