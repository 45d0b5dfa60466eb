"""Renderers by their names on the command line, with or without a measured bank of kernels; the only module that knows them all."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mrbokeh.layering.layering import Layering
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError

_log = logging.getLogger(__name__)

DEFAULT = "polygon"


def _scatter(**settings: Any) -> Renderer:
    from mrbokeh.renderers.scatter_reference import ScatterReference

    return ScatterReference(**settings)


def _polygon(**settings: Any) -> Renderer:
    from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences

    return PolygonDifferences(**settings)


def _low_rank(**settings: Any) -> Renderer:
    from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter

    return LowRankFilter(**settings)


def _laplacian(**settings: Any) -> Renderer:
    from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets

    return LaplacianSpreadlets(**settings)


def _lrdm(**settings: Any) -> Renderer:
    """Make the renderer that takes layers as they are, without slices."""
    from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction

    return LayeredReconstruction(threads=settings["threads"], device=settings.get("device", ""))


BY_NAME = {"polygon": _polygon, "low-rank": _low_rank, "laplacian": _laplacian, "lrdm": _lrdm, "scatter": _scatter}

ON_DEVICES = ("laplacian", "lrdm")
WITH_BANKS = ("polygon", "low-rank", "laplacian", "scatter")


def make_renderer(
    name: str, *, threads: int = 0, layering: Layering | None = None, device: str = "", kernels: Mapping[str, Any] | None = None
) -> Renderer:
    """Return the renderer of that name, or the network in that .onnx file (which takes every layer as it is, without slices).

    kernels: `bank`, and what is known of it already, as the renderer's constructor takes them (those of WITH_BANKS).
    device: "" for compiled loops on the CPU; "cuda", "cuda:1" or "cpu" for torch there, where the renderer has such a twin.
    """
    if device and name not in ON_DEVICES:
        raise InputError(f"--device is for --renderer {' or '.join(ON_DEVICES)}, got {name!r}: others run on the CPU, leave --device out")
    if name in BY_NAME:
        on = {"device": device} if device else {}
        return BY_NAME[name](threads=threads, layering=layering or Layering(), **on, **kernels or {})
    if name.lower().endswith(".onnx"):
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        return OnnxNetwork(Path(name), threads)
    raise InputError(f"expected a renderer ({', '.join(BY_NAME)}) or the path of a network (.onnx), got {name!r}")


def lens_and_renderer(lens: Path | None, renderer: str | None) -> tuple[Lens | None, Renderer]:
    """Return lens and renderer of `--lens` and `--renderer`: a network brings its lens, a lens file is rendered by the default."""
    if lens is not None and lens.suffix.lower() == ".onnx":
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        network = OnnxNetwork(lens)
        if network.facts.lens_guessed:
            _log.warning(
                f"{lens} was trained on stacks whose metres are guessed: how large its blur is at a distance is a guess too; "
                f"as --renderer it blurs by the lens of the stack or photograph"
            )
        return network.lens, network if renderer is None else make_renderer(renderer)
    return None if lens is None else read_lens(lens), make_renderer(renderer or DEFAULT)


def chosen_renderer(method: str, psf: Path | None, *, threads: int = 0, layering: Layering | None = None, device: str = "") -> Renderer:
    """Return the renderer of that name; psf: the folder of a bank of kernels in place of the lens's opening."""
    if psf is None:
        return make_renderer(method, threads=threads, layering=layering, device=device)
    if method not in WITH_BANKS:
        raise InputError(
            f"--psf is for --renderer {', '.join(WITH_BANKS)}, got --renderer {method}: other methods take the opening of the lens file"
        )
    from mrbokeh.optics.psf_bank_file import read_bank

    kernels = {"bank": read_bank(psf)}
    return make_renderer(method, threads=threads, layering=layering, device=device, kernels=kernels | _beside(method, psf, kernels["bank"]))


def _beside(method: str, psf: Path, bank: PsfBank) -> dict[str, Any]:
    """Return the files that the method keeps beside a bank, as arguments of its constructor."""
    from mrbokeh.renderers.bank.kernel_files import apertures_beside, terms_beside
    from mrbokeh.renderers.bank.lattice import BankLattice

    if method == "laplacian":
        from mrbokeh.renderers.bank.kernel_files import spreadlets_beside

        return {"spreadlets": spreadlets_beside(psf, bank.kernels)}
    if method == "polygon":
        return {"apertures": apertures_beside(psf, BankLattice(bank))}
    if method == "low-rank":
        from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter

        filters = LowRankFilter()
        return {"terms": terms_beside(psf, BankLattice(bank), filters.decomposed, [filters.relative_error, filters.max_rank])}
    return {}
