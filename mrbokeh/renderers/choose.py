"""Lenses and the renderers of their blur; the only module that knows them all.

A lens is a description (LENS.json, or a name of the lens library), whose opening any renderer spreads light by, a bank of kernels (a
folder) or a network (.onnx). The last two have their own ways of spreading light, which travel with the `Lens` as the path in
`Lens.spread_by`.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from mrbokeh.layering.layering import Layering
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens as read_description
from mrbokeh.optics.lens_library import shipped
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.optics.psf_bank_file import HEAD, read_bank
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

ON_DEVICES = ("polygon", "laplacian", "lrdm")
WITH_BANKS = ("polygon", "low-rank", "laplacian", "scatter")


def make_renderer(name: str, *, threads: int = 0, layering: Layering | None = None, device: str = "") -> Renderer:
    """Return the renderer of that name, the network in that .onnx file (which takes every layer as it is, without slices), or the best one
    of the bank in that folder.

    device: "" for compiled loops on the CPU; "cuda", "cuda:1" or "cpu" for torch there, where the renderer has such a twin.
    """
    settings: dict[str, Any] = {"threads": threads, "layering": layering or Layering()}
    if is_bank(name):
        return _of_bank(Path(name), _read_bank(Path(name)), None, settings, device)
    if name in BY_NAME:
        return BY_NAME[name](**settings, **_on(device, name))
    _on(device, name)
    if name.lower().endswith(".onnx"):
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        return OnnxNetwork(Path(name), threads)
    raise InputError(f"expected a renderer ({', '.join(BY_NAME)}), a network (.onnx) or the folder of a bank of PSFs, got {name!r}")


def lens_and_renderer(
    lens: Path | None, renderer: str | None, *, threads: int = 0, layering: Layering | None = None, device: str = ""
) -> tuple[Lens | None, Renderer]:
    """Return lens and renderer of `--lens` and `--renderer`: networks and banks bring both, a lens file is rendered by the default.

    Of a bank that does not say which lens it was made for, the lens is None: what it blurs has to tell. renderer: of a bank one of
    WITH_BANKS, by which its kernels are spread. threads, layering, device: see `make_renderer`.
    """
    if is_bank(lens):
        assert lens is not None
        from mrbokeh.renderers.bank.bank_lens import lens_of

        bank = _read_bank(lens)
        settings = {"threads": threads, "layering": layering or Layering()}
        return _spread_by(lens_of(bank), lens), _of_bank(lens, bank, renderer, settings, device)
    if lens is not None and lens.suffix.lower() == ".onnx":
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        network = OnnxNetwork(lens, threads)
        if network.facts.lens_guessed:
            _log.warning(
                f"{lens} was trained on stacks whose metres are guessed: how large its blur is at a distance is a guess too; "
                f"as --renderer it blurs by the lens of the stack or photograph"
            )
        made = network if renderer is None else make_renderer(renderer, threads=threads, layering=layering, device=device)
        return _spread_by(network.lens, lens), made
    made = make_renderer(renderer or DEFAULT, threads=threads, layering=layering, device=device)
    return None if lens is None else read_description(lens), made


def read_lens(path: Path | str) -> Lens:
    """Read a lens: a description (LENS.json, or a name of the library), a bank of PSFs (its folder) or a network (.onnx).

    The last two keep their own blur.

    A bank that does not say which lens it was made for gives that of `Lens.default` with its opening: `Lens.stating` says more. Raises
    InputError where it is none.
    """
    path = Path(path)
    if is_bank(path):
        from mrbokeh.renderers.bank.bank_lens import lens_of, opening_of

        bank = _read_bank(path)
        return replace(lens_of(bank) or replace(Lens.default(), aperture=opening_of(bank)), spread_by=path)
    if path.suffix.lower() == ".onnx":
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        return replace(OnnxNetwork(path).lens, spread_by=path)
    return read_description(path)


def spreads_light(lens: Path | None) -> bool:
    """Return whether a lens is a bank or a network, which have their own renderer."""
    return is_bank(lens) or (lens is not None and lens.suffix.lower() == ".onnx")


def files_of(lens: Path) -> list[Path]:
    """Return the file that changes when a lens, bank or network changes; that of a name of the lens library."""
    return [lens / HEAD if is_bank(lens) else shipped(lens)]


def is_bank(path: Path | str | None) -> bool:
    """Return whether a lens or renderer is named by a folder, which should be that of a bank."""
    return path is not None and str(path) not in BY_NAME and Path(path).is_dir()


def _read_bank(folder: Path) -> PsfBank:
    if not (folder / HEAD).is_file():
        raise InputError(
            f"expected a lens at {folder}, but it is a folder that holds no bank of PSFs ({HEAD}): give LENS.json, or a folder of "
            f"`mrbokeh lens psf` or `lens fit`"
        )
    return read_bank(folder)


def _spread_by(lens: Lens | None, path: Path) -> Lens | None:
    return None if lens is None else replace(lens, spread_by=path)


def _on(device: str, name: str) -> dict[str, str]:
    """Return the device as an argument of a renderer's constructor. Raises InputError if it has no twin there."""
    if device and name not in ON_DEVICES:
        raise InputError(f"--device is for --renderer {' or '.join(ON_DEVICES)}, got {name!r}: others run on the CPU, leave --device out")
    return {"device": device} if device else {}


def _of_bank(folder: Path, bank: PsfBank, method: str | None, settings: dict[str, Any], device: str) -> Renderer:
    """Return a renderer by a bank of kernels. method: None takes polygons where they can stand for the kernels, else laplacian."""
    from mrbokeh.renderers.bank.bank_lens import polygons_suit

    name = method or (DEFAULT if polygons_suit(bank) else "laplacian")
    if name not in WITH_BANKS:
        raise InputError(f"the bank {folder} is for --renderer {', '.join(WITH_BANKS)}, got {name}: it takes the opening of a lens file")
    return BY_NAME[name](**settings, **_on(device, name), bank=bank, **_beside(name, folder, bank))


def _beside(method: str, folder: Path, bank: PsfBank) -> dict[str, Any]:
    """Return the files that the method keeps beside a bank, as arguments of its constructor."""
    from mrbokeh.renderers.bank.kernel_files import apertures_beside, terms_beside
    from mrbokeh.renderers.bank.lattice import BankLattice

    if method == "laplacian":
        from mrbokeh.renderers.bank.kernel_files import spreadlets_beside

        return {"spreadlets": spreadlets_beside(folder, bank.kernels)}
    if method == "polygon":
        return {"apertures": apertures_beside(folder, BankLattice(bank))}
    if method == "low-rank":
        from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter

        filters = LowRankFilter()
        return {"terms": terms_beside(folder, BankLattice(bank), filters.decomposed, [filters.relative_error, filters.max_rank])}
    return {}
