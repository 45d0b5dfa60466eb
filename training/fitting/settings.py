"""Settings of a training run in one frozen dataclass, saved as JSON beside the result; presets; `--set name=value` overrides."""

import difflib
import math
import types
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from training.networks.network_settings import NetworkSettings

FORMAT = "mrbokeh-training-settings"
VERSION = 1
FILE_NAME = "settings.json"
TUNING_RATE = 0.25
_TRUTH = {"true": True, "false": False}
PLACE = ("threads", "device", "cache_mib", "checkpoint_every_s", "sheets")
"""Where a run computes and what it keeps; a run that goes on may have others."""
_NOT_TOLD = ("network", "seed", "minutes", "epochs", "validate_every_s", *PLACE)
_BUDGETS = {"minutes": "epochs", "epochs": "minutes"}


@dataclass(frozen=True)
class TrainSettings:
    """One training run.

    minutes, epochs: the budget; the learning rate follows it (short warm-up, then a cosine to zero), over elapsed time
        for minutes, over steps for epochs. An epoch shows as many pictures as there are pairs.
    crop_px: side of the square crops, 0 for whole pictures; larger where the largest blur would leave less than half of it.
        Crops are for one tile only: the loss of the published network is
        over the reassembled picture.
    loss_scope: "picture" takes the error of the reassembled picture as published, "tile" that of every tile by itself (Table 1, last row).
    loss_weighting: the loss is a mean square error; "uniform" as published, "relative" divides each error by the true
        radiance where that is above white (1.0), so that a few lights do not outweigh the picture.
    energy_weight: of a second term, the squared error of the light in each neighbourhood as large as the largest blur; 0 as published.
    edge_weight: of a third term, the squared error of the result's gradients; 0 as published.
    depth_noise: how badly depth is made worse while training (training/data/batches.py): 1 as bad as multi-view stereo, 0 not at all.
    sensor_white: radiance at which the sensor of the photographs saturates; result and slice are both clipped there before they are
        compared, so that a light may be as bright as it is. None compares them as they are.
    radiance_scale: the radiance that is mapped to +1 (0 to -1); None takes that of the data set's manifest, or for scene folders the
        largest value of the training pictures.
    least_confidence: pixels with less trustworthy depth do not count; 0 counts all. Pixels that moved, have no data, show a calibration
        board never count (training/data/pairs.py).
    saturated: pixels whose slice was saturated are "left_out" (with sensor_white they count), or count "one_sided": only a result
        darker than the slice is an error.
    saturation: pixels of a slice at or above this radiance do not count either, for slices without a saturation mask; None is no limit.
    clip_norm: gradients longer than this are shortened to it; 0 leaves them as they are.
    crops_per_picture: so many crops in a row are cut from one picture, which is read once for them all.
    ema_decay: the result is this exponential moving average over steps of the weights; 0 takes the last weights.
    precision: of the network's arithmetic while training; the half types are for GPUs.
    patience: stop after so many looks at the held-out slices without a better one; 0 never stops early.
    sheets: write a sheet of predictions on held-out slices at every look, so that one can watch it learn.
    test_fraction: of the stacks (viewpoints) of scene folders, held out when no names are given; the paper's split is 80 : 20.
        Of a single stack every fourth slice is held out, none where this is 0. A data set has its own split.
    """

    network: NetworkSettings = field(default_factory=NetworkSettings)
    seed: int = 0
    minutes: float | None = None
    epochs: int | None = 50
    learning_rate: float = 1e-3
    warm_up: float = 0.05
    batch: int = 1
    crop_px: int = 0
    crops_per_picture: int = 1
    loss_scope: Literal["picture", "tile"] = "picture"
    loss_weighting: Literal["uniform", "relative"] = "uniform"
    energy_weight: float = 0.0
    edge_weight: float = 0.0
    depth_noise: float = 0.0
    sensor_white: float | None = None
    radiance_scale: float | None = None
    least_confidence: float = 0.1
    saturation: float | None = None
    saturated: Literal["left_out", "one_sided"] = "left_out"
    clip_norm: float = 0.0
    ema_decay: float = 0.0
    test_fraction: float = 0.2
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    patience: int = 0
    sheets: bool = True
    device: str = "auto"
    threads: int = 0
    checkpoint_every_s: float = 30.0
    validate_every_s: float = 60.0
    cache_mib: int = 2048

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.epochs is None):
            raise InputError(f"give the budget either in minutes or in epochs, got minutes={self.minutes} and epochs={self.epochs}")
        for name, least in (("batch", 1), ("crops_per_picture", 1), ("crop_px", 0), ("patience", 0), ("threads", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be {least} or more, got {getattr(self, name)}")
        if not 0.0 < self.learning_rate < math.inf:
            raise InputError(f"learning_rate must be a positive number, got {self.learning_rate}")
        if self.crop_px and self.network.tile_px:
            raise InputError(
                f"crops of {self.crop_px} px cannot train a network of {self.network.tile_px} px tiles, each of which has its own place "
                f"in the picture: set crop_px to 0, or tile_px to 0"
            )


def settings_to_json(settings: TrainSettings) -> dict[str, Any]:
    return {"format": FORMAT, "version": VERSION, **asdict(settings)}


def settings_from_json(document: dict[str, Any], where: str = "settings") -> TrainSettings:
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        got = f"{document.get('format')!r} version {document.get('version')}"
        raise InputError(f"{where}: expected format {FORMAT!r} version {VERSION}, got {got}: train again")
    values = {name: value for name, value in document.items() if name not in ("format", "version")}
    return _checked(TrainSettings, values | {"network": _checked(NetworkSettings, values.get("network", {}), where)}, where)


Settings = TypeVar("Settings", NetworkSettings, TrainSettings)


def _checked(kind: type[Settings], values: dict[str, Any], where: str) -> Settings:
    """Build the dataclass from its JSON; raises InputError for an unknown name."""
    unknown = set(values) - {each.name for each in fields(kind)}
    if unknown:
        raise InputError(f"{where} has unknown settings {sorted(unknown)}: expected some of {[each.name for each in fields(kind)]}")
    return kind(**values)


def write_settings(folder: Path, settings: TrainSettings) -> None:
    write_json(folder / FILE_NAME, settings_to_json(settings))


def read_settings(folder: Path) -> TrainSettings:
    return load_settings(folder / FILE_NAME)


def load_settings(path: Path) -> TrainSettings:
    return settings_from_json(read_json(path, "the settings of a training run (settings.json)"), str(path))


def with_overrides(settings: TrainSettings, assignments: Sequence[str]) -> TrainSettings:
    """Replace a setting for each "name=value"; names of the network's shape begin with "network.".

    Giving one budget (minutes or epochs) removes the other. Raises InputError for an unknown name or a value of the wrong type.
    """
    types_of = _types(TrainSettings)
    given = dict(_assignment(each, types_of) for each in assignments)
    for name, other in _BUDGETS.items():
        if given.get(name) is not None:
            given.setdefault(other, None)
    shape = {name.removeprefix("network."): value for name, value in given.items() if name.startswith("network.")}
    own = {name: value for name, value in given.items() if not name.startswith("network.")}
    return replace(settings, **own, network=replace(settings.network, **shape))


def _types(kind: type, prefix: str = "") -> dict[str, Any]:
    """Return the type by name of all settings, nested ones with a dot."""
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        found |= _types(hint, f"{prefix}{name}.") if isinstance(hint, type) and is_dataclass(hint) else {prefix + name: hint}
    return found


def _assignment(text: str, types_of: dict[str, Any]) -> tuple[str, Any]:
    name, sign, value = (part.strip() for part in text.partition("="))
    if not sign:
        raise InputError(f"expected a setting as name=value, got {text!r}: for example --set batch=4")
    if name not in types_of:
        near = difflib.get_close_matches(name, types_of, n=3)
        raise InputError(f"there is no setting {name!r}: expected one of {', '.join(near or sorted(types_of))}")
    expected, read = _reading(types_of[name])
    try:
        return name, read(value)
    except ValueError:
        raise InputError(f"the setting {name} takes {expected}, got {value!r}") from None


def _reading(hint: Any) -> tuple[str, Callable[[str], Any]]:
    """Return a type's name for people, and the function that parses its values."""
    if get_origin(hint) is Literal:
        choices = {str(choice): choice for choice in get_args(hint)}
        return "one of " + ", ".join(choices), lambda text: _among(choices, text)
    if get_origin(hint) in (Union, types.UnionType):
        name, read = _reading(next(each for each in get_args(hint) if each is not types.NoneType))
        return f"{name}, or none", lambda text: None if text.lower() == "none" else read(text)
    if hint is bool:
        return "true or false", lambda text: _among(_TRUTH, text.lower())
    return {int: ("a whole number", int), float: ("a number", float), str: ("a word", str)}[hint]


def _among(choices: dict[str, Any], text: str) -> Any:
    if text not in choices:
        raise ValueError
    return choices[text]


def demo_settings(minutes: float = 2.5) -> TrainSettings:
    """Return the preset of the demo: the gated form without tiles, which learns a lens in minutes on two cores."""
    network = NetworkSettings(
        form="gated",
        width=2,
        tile_px=0,
        overlap_px=0,
        signed_coc=True,
        activation="identity",
        initialisation="disc",
        kernels_per_colour=False,
    )
    return TrainSettings(
        network=network,
        minutes=minutes,
        epochs=None,
        learning_rate=0.02,
        batch=2,
        crop_px=128,
        sensor_white=1.0,
        ema_decay=0.97,
    )


def tuned_settings(run_folder: Path, is_tuned: bool) -> TrainSettings:
    """Return the settings to tune a finished run: its own, for 5 minutes, at a lower learning rate if it is not tuned itself."""
    own = read_settings(run_folder)
    return replace(own, minutes=5.0, epochs=None, learning_rate=own.learning_rate * (1.0 if is_tuned else TUNING_RATE))


def better_settings() -> TrainSettings:
    """Return our improvements together, for hours on a GPU: the gated form, with kernels for each colour that change over the frame.

    It is signed and without range, so that headroom does not arise, and needs no tiles, so that it takes pictures of any size.
    """
    demo = demo_settings()
    network = replace(demo.network, field_position=True, field_bases=4, kernels_per_colour=True)
    return replace(demo, network=network, minutes=None, epochs=50, learning_rate=0.01, crop_px=256, ema_decay=0.99)


def tried_rates(form: str) -> dict[str, float]:
    """Return the learning rates with which a form was tried, by preset."""
    presets = {name: preset() for name, preset in PRESETS.items()}
    return {name: each.learning_rate for name, each in presets.items() if each.network.form == form}


def changed_settings(settings: TrainSettings, base: TrainSettings) -> list[str]:
    """Return name=value for each setting that differs from the base, but where and how fast it computes."""
    now, plain = asdict(settings), asdict(base)
    network = {f"network.{name}": value for name, value in now["network"].items() if value != plain["network"][name]}
    own = {name: value for name, value in now.items() if name not in _NOT_TOLD and value != plain[name]}
    return [f"{name}={value}" for name, value in (network | own).items()]


def settings_words(settings: TrainSettings) -> str:
    """Return settings as the preset with the fewest that differ, and these."""
    differing = {name: changed_settings(settings, preset()) for name, preset in PRESETS.items()}
    name, changed = min(differing.items(), key=lambda each: len(each[1]))
    return f"preset {name}" + (f" with {', '.join(changed)}" if changed else "") + f", seed {settings.seed}"


PRESETS: dict[str, Callable[[], TrainSettings]] = {"paper": TrainSettings, "demo": demo_settings, "better": better_settings}
