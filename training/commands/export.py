"""The command `mrbokeh train export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.messages import tell

if TYPE_CHECKING:
    from mrbokeh.renderers.onnx_network import NetworkFacts


def export_command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    out: Annotated[Path, typer.Option(help="The .onnx file to write; its card NAME.md comes beside it.")],
    fast: Annotated[bool, typer.Option("--fast", help="Make it fast on a CPU, at the price of a few tenths of a decibel.")] = False,
    max_psnr_loss: Annotated[float, typer.Option(min=0.0, help="With --fast: decibel that may be lost.")] = 0.2,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Focal stacks to measure what --fast loses, and for the card where the run's have moved (repeat for more)."),
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
    from training.data.training_data import focal_stacks, training_data
    from training.export.onnx_export import card_path, write_card

    require_suffix(out, (".onnx",), "--out")
    require_safe_outputs((out, card_path(out)), (run, *(data or ())), overwrite)
    stacks = focal_stacks(training_data(data).stacks) if data else ()
    facts, form = _exported_fast(run, out, max_psnr_loss, data or []) if fast else _exported(run, out)
    write_card(run, out, facts, form, stacks)


def _exported(run: Path, out: Path) -> "tuple[NetworkFacts, str]":
    """Export and return the facts and the form in words."""
    from training.export.onnx_export import export_run

    done = export_run(run, out)
    tell(f"{out}: ONNX Runtime differs from PyTorch by {done.difference:.1e}; takes {_sizes(done.facts)}", difference=done.difference)
    return done.facts, "plain"


def _exported_fast(run: Path, out: Path, max_psnr_loss_db: float, data: list[Path]) -> "tuple[NetworkFacts, str]":
    from training.export.fast_onnx import export_fast_run

    done = export_fast_run(run, out, max_psnr_loss_db, data)
    against = "the truth" if data else "the trained network, on a made-up picture"
    tell(
        f"{out}: {done.naive_ms:.0f} ms plain, {done.fast_ms:.0f} ms fast, {done.naive_ms / done.fast_ms:.1f} times faster",
        plain_ms=done.naive_ms,
        fast_ms=done.fast_ms,
        loss_db=done.loss_db,
    )
    tell(f"loses {done.loss_db:.3f} dB of at most {max_psnr_loss_db:g} dB, measured against {against}; takes {_sizes(done.facts)}")
    tell(done.plan.words())
    return done.facts, f"fast, loses {done.loss_db:.2g} dB, measured against {against}"


def _sizes(facts: "NetworkFacts") -> str:
    return f"only {facts.width_px}x{facts.height_px} px" if facts.tiled else "any size"
