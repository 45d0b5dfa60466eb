"""The commands that judge networks: `mrbokeh train evaluate` and `mrbokeh train doctor`."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.atomic_files import refuse_existing
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, tell


def evaluate_command(
    networks: Annotated[
        list[Path],
        typer.Argument(
            metavar="NETWORK... | NETWORK SCENE...",
            help="Folders of runs and exported .onnx files. Without --data only the first is a network, the others are the data.",
        ),
    ],
    data: Annotated[
        list[Path] | None,
        typer.Option(help="A data set, or a folder of merged focal stacks or of such folders (repeat for more folders)."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables and pictures; of one network else the run, or beside the .onnx.")
    ] = None,
    renderer: Annotated[
        list[str] | None,
        typer.Option(help="Renderer to compare with (repeat for more), else polygon, low-rank, laplacian and scatter; `none` for none."),
    ] = None,
    reference: Annotated[bool, typer.Option(help="Also the scatter reference with the aperture of the lens (slow).")] = True,
    lens: Annotated[
        Path | None, typer.Option(help="LENS.json or a bank of PSFs (folder): the renderers once more, with its opening or kernels.")
    ] = None,
    pull: Annotated[int, typer.Option(min=0, help="Frames of the focus pull that shows flicker; 0 leaves it out.")] = 8,
    lpips: Annotated[
        Path | None, typer.Option(help="Weights of LPIPS as .onnx, which are not shipped; without them it is left out.")
    ] = None,
    device: Annotated[str, typer.Option(help="Where runs compute: cpu, cuda.")] = "cpu",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an evaluation that is there.")] = False,
) -> None:
    """Compare networks with no blur, Gaussians of the right size and our renderers on stacks that none of them was trained on.

    Of a data set these are the viewpoints that the networks' runs held out, whatever was given as --held-out. Networks trained on one
    stack are judged on the slices held out of it, beside the nearest slice they were trained on; that is no unseen view.

    Example: mrbokeh train evaluate runs/paper runs/gated fast.onnx --data lens_50mm --out comparison

    Example: mrbokeh train evaluate attic.onnx scenes/attic --out results

    Example: mrbokeh train evaluate runs/50mm --data lens_50mm --lens lens_50mm.bank --renderer polygon --out measured
    """
    from mrbokeh.stacks.guessed_metres import metres_notes
    from training.data.training_data import focal_stacks, training_data
    from training.evaluation.comparison import Extras, compare, unseen_of
    from training.evaluation.methods import lens_methods, nearest_method, network_methods, plain_methods, renderer_methods
    from training.evaluation.report import gain_lines, table_rows
    from training.evaluation.scores import OnnxPerceptualDistance

    networks, scenes = _networks_and_data(networks, data or [])
    folder = _folder(networks, out)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out: expected a folder, but {folder} is a file")
    refuse_existing(folder / "evaluation.md", overwrite)
    of_networks, seen = network_methods(networks, device)
    stacks = focal_stacks(training_data(scenes).stacks)
    if note := metres_notes(stacks):
        guess(note)
    unseen = unseen_of(stacks, seen)
    chosen = _renderers(renderer, reference)
    plain = [*plain_methods(), nearest_method()] if unseen.slices else plain_methods()
    methods = [*of_networks, *plain, *renderer_methods(chosen), *lens_methods(chosen, lens)]
    extras = Extras(None if lpips is None else OnnxPerceptualDistance(lpips), pull)
    result = compare(methods, unseen, folder, extras)
    tell(f"{result.slices} {unseen.words}", psnr_db={name: decibel for name, decibel, *_ in table_rows(result)})
    for name, decibel, similarity, *_ in table_rows(result):
        tell(f"{name:22s} {decibel:>7s} dB   SSIM {similarity}")
    for line in gain_lines(result):
        tell(line)
    tell(f"written to {folder}: evaluation.md, evaluation.csv, evaluation.png, evaluation_crops.png")


def _networks_and_data(paths: list[Path], data: list[Path]) -> tuple[list[Path], list[Path]]:
    if data:
        return paths, data
    if len(paths) < 2:
        raise InputError(f"expected the data to evaluate {paths[0]} on, got none: give --data")
    return paths[:1], paths[1:]


def _folder(networks: list[Path], out: Path | None) -> Path:
    if out is not None:
        return out
    if len(networks) > 1:
        raise InputError(f"expected a folder for the comparison of {len(networks)} networks, got none: give --out")
    return networks[0] if networks[0].is_dir() else networks[0].parent


def _renderers(names: list[str] | None, reference: bool) -> list[str]:
    from training.evaluation.methods import RENDERERS

    chosen = [] if names == ["none"] else names or list(RENDERERS)
    return [name for name in chosen if reference or name != "scatter"]


def doctor_command(
    run: Annotated[Path, typer.Argument(help="Folder of a run, finished or not.")],
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Its data set or focal stacks, if they are no longer where they were (repeat for more folders)."),
    ] = None,
) -> None:
    """Say what is wrong with a training run, each with its evidence and what to do.

    It looks at the curve, and at a few slices it learnt from and held-out ones, with the network beside no blur and a plain disc.

    Example: mrbokeh train doctor runs/attic
    """
    from training.data.training_data import focal_stacks, training_data
    from training.evaluation.diagnosis import diagnose

    diagnosis = diagnose(run, focal_stacks(training_data(data).stacks) if data else ())
    for number, sentence in enumerate(diagnosis.found, 1):
        tell(f"{number}. {sentence}")
    if diagnosis.found:
        tell("other options mean another run: give another --out with them, or --overwrite")
    if not diagnosis.found and not diagnosis.unseen:
        tell("nothing found wrong")
    tell(f"looked at: {'; '.join(diagnosis.looked)}", found=diagnosis.found, looked_at=diagnosis.looked, not_looked_at=diagnosis.unseen)
    if diagnosis.unseen:
        why = "its network is not finished" if diagnosis.has_pictures else "its pictures are not where they were, give --data"
        tell(f"not looked at, as {why}: {'; '.join(diagnosis.unseen)}")
