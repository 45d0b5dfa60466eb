"""How `mrbokeh render` blurs: the renderer with its bank of PSFs, and the lens with its focus."""

from pathlib import Path
from typing import Any

from mrbokeh.errors import InputError
from mrbokeh.layer import Layer, flatten
from mrbokeh.layering import Layering
from mrbokeh.lens import Lens
from mrbokeh.psf_bank import PsfBank
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import WITH_BANKS, make_renderer


def chosen_renderer(method: str, psf: Path | None, *, threads: int, layering: Layering, device: str) -> Renderer:
    """The renderer of that name; psf: a bank of kernels in place of the lens's opening."""
    if psf is None:
        return make_renderer(method, threads=threads, layering=layering, device=device)
    if method not in WITH_BANKS:
        raise InputError(
            f"--psf is for --method {', '.join(WITH_BANKS)}, got --method {method}: other methods take the opening of the lens file"
        )
    from mrbokeh.psf_bank_file import read_bank

    kernels = {"bank": read_bank(psf)}
    return make_renderer(method, threads=threads, layering=layering, device=device, kernels=kernels | _beside(method, psf, kernels["bank"]))


def _beside(method: str, psf: Path, bank: PsfBank) -> dict[str, Any]:
    """What the method keeps in files beside a bank."""
    from mrbokeh.bank_fits_file import apertures_beside, terms_beside
    from mrbokeh.bank_lattice import BankLattice

    if method == "laplacian":
        from mrbokeh.spreadlets_file import spreadlets_beside

        return {"spreadlets": spreadlets_beside(psf, bank.kernels)}
    if method == "polygon":
        return {"apertures": apertures_beside(psf, BankLattice(bank))}
    if method == "low-rank":
        from mrbokeh.renderers.low_rank_filter import LowRankFilter

        filters = LowRankFilter()
        return {"terms": terms_beside(psf, BankLattice(bank), filters.decomposed, [filters.relative_error, filters.max_rank])}
    return {}


def reconstructed(renderer: Renderer, method: str, samples: Path, lens: Lens) -> Layer:
    """A picture from noisy samples, by a renderer that takes them."""
    from mrbokeh.light_field_samples_file import read_samples

    if not hasattr(renderer, "reconstruct"):
        raise InputError(f"--samples are for --method lrdm or laplacian, got --method {method}")
    return renderer.reconstruct(read_samples(samples), lens)


def focused(lens: Lens, sharp: dict[str, Layer], focus_distance_m: float | None, focus_at: str | None) -> Lens:
    """The lens at the distance that was asked for, or focused on what is frontmost at a pixel."""
    if focus_distance_m is not None and focus_at is not None:
        raise InputError("give either --focus-distance-m or --focus-at, not both")
    if focus_distance_m is not None:
        return lens.focused_at(focus_distance_m)
    if focus_at is None:
        return lens
    try:
        x_px, y_px, radius_px = (*map(int, focus_at.split(",")), 0)[:3]
    except ValueError:
        raise InputError(f"--focus-at: expected X,Y or X,Y,RADIUS in whole pixels, got {focus_at!r}") from None
    return lens.focused_on(flatten(list(sharp.values())).depth_m, x_px + 0.5, y_px + 0.5, float(radius_px))
