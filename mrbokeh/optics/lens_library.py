"""Lens library: lenses by name, shipped as lens files (mrbokeh/lens_data/NAME.json) with the prescription that each was described from.

A prescription states: `about` what the lens is for; `patent`, `inventors`, `year` and `source`, from where its figures come; the focal
length and f-number that the patent states (scaled as the surfaces are); `closest_focus_m`, from the sensor, of a lens built to it, or
null; `surfaces`, columns as in `mrbokeh.psf_models.physical_lens.read_prescription`, radius null for a flat one; `clear_diameters`, how
they are known. `measured` is what the makers of the file computed (`python -m datasets_scripts.lens_library`): the light of a corner
as a share of the middle's, distortion in the corner, axial colour, and how much light the description misplaces (docs/lens_library.md).
"""

import difflib
from pathlib import Path
from typing import Any

from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

FOLDER = Path(__file__).resolve().parents[1] / "lens_data"
_NEAREST_NAMES = 3


def names() -> list[str]:
    """Return the names of all lenses, by focal length."""
    return sorted((path.stem for path in FOLDER.glob("*.json")), key=lambda name: (int(name.rpartition("-")[2]), name))


def facts(name: str) -> dict[str, Any]:
    """Return what `mrbokeh lens list --json` says of a lens: sizes, and its prescription without the surfaces."""
    document = read_json(FOLDER / f"{name}.json", "a lens of the library")
    described = {key: document[key] for key in ("focal_length_mm", "widest_f_number", "sensor_width_mm")}
    return {"name": name, **described} | {key: value for key, value in document["prescription"].items() if key != "surfaces"}


def shipped(path: Path | str) -> Path:
    """Return the file of the library that a name stands for; any other path, and a name that is a file or folder, stays as it is.

    Raises InputError if a bare word is neither a file nor a name of the library.
    """
    path = Path(path)
    if path.suffix or path.exists():
        return path
    known = names()
    if path.name in known:  # in whatever folder: a scene file names lenses beside itself
        return FOLDER / f"{path.name}.json"
    if len(path.parts) != 1:
        return path
    near = difflib.get_close_matches(path.name.lower(), known, _NEAREST_NAMES, 0.4) or known[:_NEAREST_NAMES]
    raise InputError(
        f"expected a lens file or a name of the lens library such as {', '.join(near)}, got {path.name!r}: `mrbokeh lens list` shows all"
    )
