"""The lens of a bank: what it was made for, if it says so, and one opening that stands for its kernels where rays go through the pupil."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.apertures import LEAST_FITTED_PX, fit_polygons
from mrbokeh.renderers.bank.blending import BlendedTables
from mrbokeh.renderers.bank.lattice import BankLattice
from mrbokeh.system.errors import InputError

_LOSSLESS = 0.99
_DRAWN_PX = 48.0  # a kernel of this size shows its shape; larger ones take longer to draw around


def stated_lens(bank: PsfBank) -> Lens | None:
    """Return the lens that a bank says it was made for, with a round opening; None if it does not say."""
    facts = bank.settings.get("lens")
    return None if facts is None else lens_from_json({**facts, "aperture": {"shape": "disc"}}, f"the lens of the bank '{bank.model}'")


def lens_of(bank: PsfBank) -> Lens | None:
    """Return the lens that a bank says it was made for, with the opening that stands for its kernels; None if it does not say."""
    stated = stated_lens(bank)
    return None if stated is None else replace(stated, aperture=opening_of(bank))


@lru_cache(maxsize=8)
def opening_of(bank: PsfBank) -> Aperture:
    """Return the opening that its kernel behind the focus in the middle of the frame shows, in green light.

    A disc if it shows none: a bank of scattering, or of kernels of less than 8 px.
    """
    kernel, diameter_px = _middle_kernel(bank)
    if diameter_px < LEAST_FITTED_PX:
        return Aperture.disc()
    try:
        return fit_polygons(kernel, diameter_px).aperture
    except InputError:
        return Aperture.disc()


@lru_cache(maxsize=8)
def is_lossless(bank: PsfBank) -> bool:
    """Return whether no kernel of a bank loses more than a hundredth of its light."""
    return min(float(kernel.sum(axis=(0, 1)).min()) for kernel in bank.kernels) > _LOSSLESS


@lru_cache(maxsize=8)
def reach_tables(bank: PsfBank) -> BlendedTables | None:
    """Return tables that tell how far the light of a diameter travels; None for a bank whose kernels differ by more than that."""
    alike = [axis.name for axis in bank.axes] == ["diameter_px"] and bank.turns == "none"
    return BlendedTables(bank, None) if alike else None


def polygons_suit(bank: PsfBank) -> bool:
    """Return whether polygons can stand for a bank's kernels: over diameter and place, some of them large enough to draw around."""
    try:
        largest_px = max(BankLattice(bank).diameters_px[1])
    except InputError:
        return False
    return bool(largest_px >= LEAST_FITTED_PX)


def _middle_kernel(bank: PsfBank) -> tuple[Float64[np.ndarray, "size size"], float]:
    """Return a kernel of the middle of the frame as behind the focus, and its circle of confusion; 0 if the bank does not tell that."""
    names, green = [axis.name for axis in bank.axes], bank.channels // 2
    if "diameter_px" in names:
        at = names.index("diameter_px")
        cell = int(bank.nearest(np.where(np.arange(len(names)) == at, min(bank.axes[at].high, _DRAWN_PX), 0.0)))
        return bank.kernels[cell][..., green].astype(np.float64), float(bank.centres[cell, at])
    lens = stated_lens(bank)
    if lens is None:
        return np.ones((1, 1)), 0.0
    places = bank.centres * (np.array(names) == "depth_m")
    coc_px = lens.coc_px(places.sum(axis=1), round(lens.sensor_width_mm / bank.settings["mm_per_px"]))
    best = int(np.argmin(np.abs(np.abs(coc_px) - _DRAWN_PX)))
    kernel = bank.kernels[int(bank.nearest(places[best]))][..., green].astype(np.float64)
    return kernel if coc_px[best] > 0 else kernel[::-1, ::-1].copy(), abs(float(coc_px[best]))
