"""Words of options in --help and in shell completion, by their names: unit, panel and choices are the same in all commands.

And how `--f-number` is read: as lenses have it written, f/1.4, in all commands.
"""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from mrbokeh.optics.lens_library import names
from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import without_f

FEW = 9
"""A command with no more options shows them on one panel."""

EVERYDAY = {
    "capture shoot": "plan source out target by-hand",
    "capture process": "out max-width board prefer overwrite",
    "capture poses": "overwrite images out mapper",
    "capture plan": "near far image-width focal-length f-number sensor-width out",
    "capture matchmove": "out ground ruler overwrite",
    "capture solve": "out picture height length line focal-length sensor-width overwrite",
    "capture scale": "ruler distance-at nearest board distance",
    "capture dataset": "out licence test overwrite",
    "train fit": "out preset minutes overwrite",
    "train evaluate": "data out renderer overwrite",
    "train ablate": "out table minutes dry-run",
    "lens new": "focal-length f-number focus sensor-width blades overwrite",
    "lens psf": "out lens diameter overwrite",
    "lens describe": "out f-number blades overwrite",
    "lens fit": "out lights overwrite",
    "lens match": "out evidence focus f-number overwrite",
    "render": "out rgb depth lens focus focus-at",
    "composite": "object at at-pixel height slice depth out overwrite",
    "video": "scene layer camera lens depth out overwrite",
    "refocus": "focus out f-number lens overwrite",
    "transfer": "out depth f-number focus focus-at lens overwrite",
    "check": "against virtual sharp",
    "track clip": "board poster width out calibrate camera overwrite",
    "track convert": "size format overwrite",
    "viewfinder": "source demo scene board lens lan",
    "viewfinder calibrate-phone": "source phone phone-camera board out",
    "studio": "object depth lens project pictures lan",
}
"""Options of a command that most people need, which come first."""

PANELS = {
    "The plate": "all-slices behind depth-model-gives depth-scale disparity exact-depth first-number frames missing input-space matte "
    "near-distance rate refine rgb srgb steady-depth stereo stereo-cameras baseline linear side light-distance sidecar",
    "What is put in": "camera catch layer mode objects paths pitch roll scene scene-begin scene-renderer time turn keyframes",
    "Its light": "environment exposure shadow",
    "Its look": "grain grey-value light-wrap match-black match-exposure match-grey match-white plate-exposure vignetting seed",
    "The lens": "distortion f-number focal-length focus focus-at focus-pull lens petzval-radius readout same-view sensor-height "
    "sensor-width sharpest shutter tilt prescription",
    "The opening": "axial-chromatic cat-eye curvature image inner lateral-chromatic levels path rotation shape "
    "spherical-aberration squeeze",
    "The blur": "alpha-out highlights motion rank renderer residuals samples slices two-passes",
    "The kernels": "anisotropy cells counts density-per-m diameters far focal-px image-width longest-motion near near-lights "
    "pixels psf-picture rays regions smoothness symmetric",
    "Metres": "dictionary distance distance-at ground lens-calibration marker metric ruler square",
    "The camera": "backlash check exposure-time far-steps focus-level focus-steps home iso live near-steps planned-distances "
    "reverse-focus settle spot sweep-step timeout white-balance",
    "Tracking": "camera-model cameras delay focus-from freed lens-table longest-gap map mapper max-image-size metres-per-unit opentrackio "
    "phone phone-camera pose rig smooth steadier horizon camera-height width",
    "The page": "captures interface lan max-rate pictures port project qr tls tls-key webcam",
    "The result": "proxy constant-rate encoding format leaks no-distortion ocio output-space overwrite preview save-deep save-depth "
    "save-layer sheet virtual-only allow-absent strict",
    "The work": "cluster device epochs max-width segment threads work workers",
}
"""Subjects of the other options; a name that is on none of them comes with "More"."""

METAVARS = {
    "MM": "focal-length sensor-width sensor-height petzval-radius square marker",
    "N": "f-number",
    "METRES": "baseline width camera-height near far near-distance light-distance depth-scale",
    "PX": "image-width max-width max-image-size residual diameter longest-motion tile-px overlap-px focal-px steadier",
    "DEGREES": "turn pitch roll rotation shutter",
    "SECONDS": "settle timeout time scene-begin readout segment seconds",
    "MS": "delay",
    "MINUTES": "minutes",
    "FPS": "rate max-rate constant-rate",
    "X,Y[,R]": "focus-at",
    "cpu|cuda": "device",
    "DEPTH": "depth",
    "LENS": "lens",
    "CAMERA": "camera phone-camera pose",
    "BOARD": "board",
    "SCENE.toml": "scene",
    "RGBAZ.exr": "layer behind",
    "SECOND": "stereo",
    "PICTURE": "rgb",
    "SOURCE": "source phone",
    "RENDERER": "renderer",
    "A,B,METRES": "distance",
    "lens.toml|focus.csv": "sidecar",
}
"""What options take, in one word."""

CHOICES = {
    "renderer": "polygon low-rank laplacian lrdm scatter",
    "scene-renderer": "auto embree wgpu mitsuba",
    "mode": "front over matte between rerender",
    "catch": "shadow light",
    "group": "folder time focus none",
    "home": "near infinity",
    "origin": "lens film_plane",
    "mapper": "incremental global",
    "camera-model": "auto SIMPLE_RADIAL RADIAL",
    "cameras": "auto shared separate",
    "depth-model-gives": "inverse metric",
    "device": "cpu cuda",
    "missing": "stop hold black",
    "encoding": "h264 h264-10bit h265-10bit prores4444 prores4444-alpha prores422 dnxhr-hqx ffv1 ffv1-alpha",
    "focus-from": "hand tracking source board",
    "ocio": "aces aces-cg",
    "paper": "a4 a3 letter board",
    "shape": "disc polygon ring star heart image outline",
    "side": "behind front",
    "capture shoot source": "gphoto2 simulated folder:",
    "viewfinder source": "gphoto2 whip test folder:",
    "viewfinder calibrate-phone source": "gphoto2 whip test folder:",
    "capture ingest white-balance": "camera",
    "lens psf model": "simple combined physical volume stylized",
}
"""Values that the shell completes, of an option in all commands or in one; where none fits, it completes files."""


SIZES = {
    "focal-length": ("millimetres above 0 and up to 10000, such as 50", 10_000.0),
    "sensor-width": ("millimetres above 0 and up to 500, such as 36", 500.0),
    "f-number": ("a number above 0, such as 2.8", math.inf),
}
"""Sizes of a lens, which all are above 0 and finite: what is expected in words, and the largest."""


def _by_name(table: dict[str, str]) -> dict[str, str]:
    return {name: word for word, names in table.items() for name in names.split()}


def with_words(command: Any, path: str) -> None:
    """Give the options of a command their words, and `--f-number` its way of being read. path: of the command, such as "lens new"."""
    panels, metavars, first = _by_name(PANELS), _by_name(METAVARS), EVERYDAY.get(path, "").split()
    for parameter in command.params:
        name = parameter.opts[0].removeprefix("--") if parameter.param_type_name == "option" else parameter.name
        choices = CHOICES.get(f"{path} {name}") or CHOICES.get(name)
        if choices and not parameter.type_descriptor.is_choice:
            parameter.shell_complete = _completing(choices.split)
        elif name in ("lens", "prescription"):
            parameter.shell_complete = _completing(names)
        if parameter.param_type_name == "option":
            parameter.metavar = metavars.get(name, parameter.metavar)
            if name == "f-number":
                parameter.process_value = _of_f_number(parameter.process_value)
            if name in SIZES:
                parameter.process_value = _within(name, parameter.process_value)
            if len(command.params) > FEW and name not in first:
                parameter.rich_help_panel = panels.get(name, "More")
    order = {name: place for place, name in enumerate(first)}
    command.params.sort(key=lambda each: order.get(each.opts[0].removeprefix("--"), len(order)))


def _of_f_number(process: Callable[[Any, Any], Any]) -> Any:
    return lambda context, value: process(context, without_f(value))


def _within(name: str, process: Callable[[Any, Any], Any]) -> Any:
    """Refuse a size of a lens that none has, before any file is opened."""
    expected, largest = SIZES[name]

    def processed(context: Any, value: Any) -> Any:
        size = process(context, value)
        if isinstance(size, float) and not (0.0 < size <= largest and math.isfinite(size)):
            raise InputError(f"--{name}: expected {expected}, got {size:g}")
        return size

    return processed


def _completing(choices: Callable[[], list[str]]) -> Any:
    return lambda _context, incomplete: [
        SimpleNamespace(value=each, type="plain", help=None) for each in choices() if each.startswith(incomplete)
    ]
