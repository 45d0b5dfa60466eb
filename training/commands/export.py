"""The command `mrbokeh train export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.channel import tell

if TYPE_CHECKING:
    from mrbokeh.renderers.onnx_network import NetworkFacts


def export_command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    out: Annotated[Path, typer.Option(help="The .onnx file to write; its card NAME.md comes beside it.")],
    fast: Annotated[bool, typer.Option("--fast", help="Make it fast on a CPU, at the price of a few tenths of a decibel.")] = False,
    max_psnr_loss: Annotated[float, typer.Option(min=0.0, help="With --fast: decibel that may be lost.")] = 0.2,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="With --fast: focal stacks to measure the loss against the truth (repeat for more); else a made-up picture."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Write the network as ONNX, with its lens inside, after checking that ONNX Runtime agrees with PyTorch, and a card beside it.

    The card, NAME.md, says what it learnt from and under which licence, how good it is on held-out slices, its limits, and who made it.

    With --fast large kernels run at a fraction of the resolution, or as sums of separable ones, as boldly as the budget allows; nothing
    is written where it is not met.

    Example: mrbokeh train export runs/attic --out attic.onnx

    Example: mrbokeh train export runs/attic --out attic_fast.onnx --fast --max-psnr-loss 0.1 --data scenes/attic
    """
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.system.atomic_files import require_safe_outputs
    from mrbokeh.system.errors import InputError
    from training.export.model_card import card_path, write_card

    if data and not fast:
        raise InputError("--data measures what --fast loses: add --fast, or leave --data out")
    require_suffix(out, (".onnx",), "--out")
    require_safe_outputs((out, card_path(out)), (run, *(data or ())), overwrite)
    if fast:
        _export_fast(run, out, max_psnr_loss, data or [])
        return
    from training.export.onnx_export import export_run

    exported = export_run(run, out)
    write_card(run, out, exported.facts)
    tell(
        f"{out}: ONNX Runtime differs from PyTorch by {exported.difference:.1e}; takes {_sizes(exported.facts)}",
        difference=exported.difference,
    )


def _export_fast(run: Path, out: Path, max_psnr_loss_db: float, data: list[Path]) -> None:
    from training.export.fast_onnx import export_fast_run
    from training.export.model_card import write_card

    done = export_fast_run(run, out, max_psnr_loss_db, data)
    write_card(run, out, done.facts)
    against = "the truth" if data else "the trained network, on a made-up picture"
    tell(
        f"{out}: {done.naive_ms:.0f} ms plain, {done.fast_ms:.0f} ms fast, {done.naive_ms / done.fast_ms:.1f} times faster",
        plain_ms=done.naive_ms,
        fast_ms=done.fast_ms,
        loss_db=done.loss_db,
    )
    tell(f"loses {done.loss_db:.3f} dB of at most {max_psnr_loss_db:g} dB, measured against {against}; takes {_sizes(done.facts)}")
    tell(done.plan.words())


def _sizes(facts: "NetworkFacts") -> str:
    return f"only {facts.width_px}x{facts.height_px} px" if facts.tiled else "any size"
