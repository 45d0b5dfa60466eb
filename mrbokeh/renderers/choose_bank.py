"""A renderer with a measured bank of kernels in place of the lens's opening, and what its method keeps in files beside the bank."""

from pathlib import Path
from typing import Any

from mrbokeh.layering.layering import Layering
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import WITH_BANKS, make_renderer
from mrbokeh.system.errors import InputError


def chosen_renderer(method: str, psf: Path | None, *, threads: int = 0, layering: Layering | None = None, device: str = "") -> Renderer:
    """The renderer of that name; psf: a bank of kernels in place of the lens's opening."""
    if psf is None:
        return make_renderer(method, threads=threads, layering=layering, device=device)
    if method not in WITH_BANKS:
        raise InputError(
            f"--psf is for --method {', '.join(WITH_BANKS)}, got --method {method}: other methods take the opening of the lens file"
        )
    from mrbokeh.optics.psf_bank_file import read_bank

    kernels = {"bank": read_bank(psf)}
    return make_renderer(method, threads=threads, layering=layering, device=device, kernels=kernels | _beside(method, psf, kernels["bank"]))


def _beside(method: str, psf: Path, bank: PsfBank) -> dict[str, Any]:
    """What the method keeps in files beside a bank."""
    from mrbokeh.renderers.bank.fits_file import apertures_beside, terms_beside
    from mrbokeh.renderers.bank.lattice import BankLattice

    if method == "laplacian":
        from mrbokeh.renderers.kernels.spreadlets_file import spreadlets_beside

        return {"spreadlets": spreadlets_beside(psf, bank.kernels)}
    if method == "polygon":
        return {"apertures": apertures_beside(psf, BankLattice(bank))}
    if method == "low-rank":
        from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter

        filters = LowRankFilter()
        return {"terms": terms_beside(psf, BankLattice(bank), filters.decomposed, [filters.relative_error, filters.max_rank])}
    return {}
