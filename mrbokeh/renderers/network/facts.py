"""What an exported network says about itself, as JSON in the metadata of its file (contract 2)."""

import json
from dataclasses import dataclass
from typing import Any

from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-neural-bokeh"
VERSION = 1
METADATA_KEY = "mrbokeh"


@dataclass(frozen=True)
class NetworkFacts:
    """What an exported network holds for.

    lens: its focus may change, and where they are inputs f-number and focal length, but nothing else.
    width_px, height_px: the pictures it was trained on; the only size when tiled.
    largest_coc_px: the largest diameter it was trained for. radiance_scale: the largest radiance it was trained for.
    reach_px: how far from a pixel the network looks. commit: of the training code, or None.
    trained_on: names of the stacks. held_out_slices: those of the only one that were not.
    field_position: the place in the frame is an input. f_numbers, focal_lengths_mm: (lowest, highest) trained on, where the lens is an
    input, else None. These, held_out_slices and lens_guessed are missing in older files.
    lens_guessed: it was trained on blur in pixels, in metres that nobody knows: the lens stands for no length.
    """

    lens: Lens
    width_px: int
    height_px: int
    largest_coc_px: float
    radiance_scale: float
    signed_coc: bool
    tiled: bool
    linear_in_radiance: bool
    reach_px: int
    trained_on: tuple[str, ...] = ()
    commit: str | None = None
    field_position: bool = False
    f_numbers: tuple[float, float] | None = None
    focal_lengths_mm: tuple[float, float] | None = None
    held_out_slices: tuple[int, ...] = ()
    lens_guessed: bool = False

    @property
    def lens_inputs(self) -> bool:
        """Whether f-number and focal length are inputs."""
        return self.f_numbers is not None and self.focal_lengths_mm is not None

    def to_json(self) -> str:
        return json.dumps({"format": FORMAT, "version": VERSION, **vars(self), "lens": lens_to_json(self.lens)})


def facts_from_json(text: str, where: str) -> NetworkFacts:
    """Raises InputError where the text is of another format or version."""
    document: dict[str, Any] = json.loads(text)
    if document.pop("format", None) != FORMAT or document.pop("version", None) != VERSION:
        raise InputError(f"{where}: expected a network of format {FORMAT!r} version {VERSION}: export it again with `mrbokeh train export`")
    lens = lens_from_json(document.pop("lens"), where)
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in document.items()}
    return NetworkFacts(lens=lens, **values)
