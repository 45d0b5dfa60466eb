"""All checks over a shot, one picture at a time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mrbokeh.checks.checked_picture import SHARP, VIRTUAL, CheckedPicture, with_layers
from mrbokeh.checks.findings import CheckReport, Finding
from mrbokeh.checks.flicker_score import FlickerScore
from mrbokeh.checks.leak_map import LeakMap, reach
from mrbokeh.checks.light_checks import check_energy, check_numbers
from mrbokeh.checks.pairing import pairs
from mrbokeh.checks.shots import Shot
from mrbokeh.images.image_io import read_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class CheckSettings:
    """layers: files of layers by name (virtual, sharp), one for all pictures, or a folder with one for each.

    lens: as focused for the shot, to find the reach of a sharp layer. energy_tolerance: share of the light. flicker_limit: mean
    absolute difference beyond the plate's own. tolerance: what a pixel may differ from the plate (sRGB code; in EXR share of the
    light); None: what storing it explains. frames: of the plate, from which the shot was made.
    """

    layers: Mapping[str, Path] = field(default_factory=dict)
    lens: Lens | None = None
    energy_tolerance: float = 0.01
    flicker_limit: float = 0.002
    tolerance: float | None = None
    frames: tuple[int, int | None] = (0, None)


def check_shot(shot: Shot, plate: Shot | None, settings: CheckSettings) -> tuple[CheckReport, LeakMap]:
    """Raises InputError where no picture can be read, or the plate is of another size."""
    report, leaks, flicker = CheckReport(), LeakMap(settings.tolerance), FlickerScore()
    passed = track(pairs(report, shot, plate, settings.frames), f"checking {shot.path.name}", len(shot.numbers or ()))
    still = {name: read_layer(path) for name, path in settings.layers.items() if not path.is_dir()}
    for index, (picture, other) in enumerate(passed):
        if isinstance(picture, str):
            report.findings.append(Finding("damaged", shot.path.name, picture, 1.0, 0.0))
            flicker.skip()
            continue
        report.pictures += 1
        complete = with_layers(picture, still | _layers(settings.layers, index))
        _check_one(report, complete, other, settings, leaks)
        if other is not None and shot.is_sequence:
            flicker.add(report, picture.name, picture.rgb, other.rgb)
    if not report.pictures:
        raise InputError(f"no picture of {shot.path} can be read: {report.findings[-1].text if report.findings else 'it is empty'}")
    flicker.judge(report, settings.flicker_limit)
    return report, leaks


def _check_one(report: CheckReport, picture: CheckedPicture, plate: CheckedPicture | None, settings: CheckSettings, leaks: LeakMap) -> None:
    check_numbers(report, picture, None if plate is None else plate.rgb)
    check_energy(report, picture, settings.energy_tolerance)
    if not {VIRTUAL, SHARP} <= picture.layers.keys():
        report.skipped["energy"] = "needs the virtual layer before and after the blur: give --sharp and --virtual, or a layered EXR"
    if plate is None:
        report.skipped |= dict.fromkeys(("leak", "flicker"), "needs the photograph or clip: give --against")
        return
    reached = reach(picture, settings.lens)
    if reached is None:
        report.skipped["leak"] = "needs to know where virtual light arrives: give --virtual, or --sharp with --lens, or a layered EXR"
    else:
        leaks.add(report, picture, plate.rgb, reached)


def _layers(files: Mapping[str, Path], index: int) -> dict[str, Layer]:
    """Those of which there is one for each picture."""
    return {name: read_layer(_of_picture(folder, index)) for name, folder in files.items() if folder.is_dir()}


def _of_picture(folder: Path, index: int) -> Path:
    files = sorted(each for each in folder.glob("*.exr") if not each.name.startswith("."))
    if index >= len(files):
        raise InputError(f"{folder} holds {len(files)} layers (.exr), too few for the pictures: expected one for each")
    return files[index]
