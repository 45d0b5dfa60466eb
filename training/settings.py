"""Every choice of a training run in one frozen dataclass, saved as JSON beside the result."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar

from mrbokeh.atomic_files import read_json, write_json
from mrbokeh.errors import InputError

FORMAT = "mrbokeh-training-settings"
VERSION = 1
FILE_NAME = "settings.json"


@dataclass(frozen=True)
class NetworkSettings:
    """The shape of the network. The defaults are Neural Bokeh as published (Mandl et al. 2024, Section 3).

    form: "published" stacks residual blocks one after the other; "gated" is our variant in which every kernel size
        serves the pixels whose circle of confusion it fits (training/gated_network.py).
    blocks: N; None takes the smallest N whose largest kernel, 2N+1 px, covers the largest circle of confusion of the data.
    width: published form: features per colour channel (the paper's three-channel tensor is 1);
        gated form: kernels per kernel size.
    mixing: published form: "none" convolves every feature by itself, "colour" lets the features of one colour mix in each
        convolution, "tile" adds a 1x1 convolution over all features of a tile after every block.
    activation: of the output; "tanh" as published, "identity" has no upper end.
    tile_px, overlap_px: t and t_o; neighbouring tiles start t - t_o px apart. tile_px 0 is one tile of any size.
    signed_coc: tell near from far (the paper's circle of confusion has no sign).
    padding: what lies beyond the border for the published form; the gated form renormalises what is inside.
    initialisation: published form: "default" (PyTorch's), "identity" (the network starts by copying the picture) or "disc"
        (the first convolution of each block a disc of its size, the second adding a little of it);
        gated form: kernels start as "disc" or, by "default", as flat squares.
    hidden: gated form: features of the pointwise network that decides who hides whom.
    kernels_per_colour: gated form: each colour has its own kernels, as a lens with chromatic aberration needs; or all share one.
    """

    form: Literal["published", "gated"] = "published"
    blocks: int | None = None
    width: int = 1
    mixing: Literal["none", "colour", "tile"] = "none"
    activation: Literal["tanh", "identity"] = "tanh"
    tile_px: int = 200
    overlap_px: int = 60
    signed_coc: bool = False
    padding: Literal["replicate", "reflect", "zeros"] = "replicate"
    initialisation: Literal["default", "identity", "disc"] = "identity"
    hidden: int = 32
    kernels_per_colour: bool = True

    def __post_init__(self) -> None:
        if self.tile_px and not 0 <= self.overlap_px < self.tile_px:
            raise InputError(
                f"tiles need 0 <= overlap_px < tile_px, got an overlap of {self.overlap_px} px with tiles of {self.tile_px} px"
            )
        if self.width < 1 or self.hidden < 1 or (self.blocks is not None and self.blocks < 1):
            raise InputError(f"expected width, hidden and blocks of at least 1, got {self.width}, {self.hidden}, {self.blocks}")


@dataclass(frozen=True)
class TrainSettings:
    """One training run.

    minutes, epochs: the budget; the learning rate follows it (short warm-up, then a cosine to zero), over elapsed time
        for minutes, over steps for epochs. An epoch shows as many pictures as there are pairs.
    crop_px: side of the square crops, 0 for whole pictures. Crops are for one tile only: the loss of the published network is
        over the reassembled picture.
    loss_weighting: the loss is a mean square error; "uniform" as published, "relative" divides each error by the true
        radiance where that is above white (1.0), so that a few lights do not outweigh the picture.
    sensor_white: radiance at which the sensor of the photographs saturates; result and slice are both clipped there before they are
        compared, so that a light may be as bright as it is. None compares them as they are.
    radiance_scale: the radiance that is mapped to +1 (0 to -1); None takes that of the data set's manifest, or for scene folders the
        largest value of the training pictures.
    least_confidence: pixels with less trustworthy depth do not count; 0 counts all. Pixels that moved, have no data, show a calibration
        board or are marked as saturated in the slice never count (training/weights.py).
    saturation: pixels of a slice at or above this radiance do not count either, for slices without a saturation mask; None is no limit.
    ema_decay: the result is this exponential moving average over steps of the weights; 0 takes the last weights.
    test_fraction: of the stacks (viewpoints) of scene folders, held out when no names are given; the paper's split is 80 : 20.
        A data set has its own split.
    """

    network: NetworkSettings = field(default_factory=NetworkSettings)
    seed: int = 0
    minutes: float | None = None
    epochs: int | None = 50
    learning_rate: float = 1e-3
    warm_up: float = 0.05
    batch: int = 1
    crop_px: int = 0
    loss_weighting: Literal["uniform", "relative"] = "uniform"
    sensor_white: float | None = None
    radiance_scale: float | None = None
    least_confidence: float = 0.1
    saturation: float | None = None
    ema_decay: float = 0.0
    test_fraction: float = 0.2
    device: str = "auto"
    threads: int = 0
    checkpoint_every_s: float = 30.0
    validate_every_s: float = 60.0
    cache_mib: int = 2048

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.epochs is None):
            raise InputError(f"give the budget either in minutes or in epochs, got minutes={self.minutes} and epochs={self.epochs}")
        if self.crop_px and self.network.tile_px:
            raise InputError(
                f"crops of {self.crop_px} px cannot train a network of {self.network.tile_px} px tiles, each of which has its own place "
                f"in the picture: set crop_px to 0, or tile_px to 0"
            )


def demo_settings(minutes: float = 2.5) -> TrainSettings:
    """The preset of the demo: the gated form without tiles, which learns a lens in minutes on two cores."""
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


PRESETS: dict[str, Callable[[], TrainSettings]] = {"paper": TrainSettings, "demo": demo_settings}


def settings_to_json(settings: TrainSettings) -> dict[str, Any]:
    return {"format": FORMAT, "version": VERSION, **asdict(settings)}


def settings_from_json(document: dict[str, Any], where: str = "settings") -> TrainSettings:
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f"{where}: expected format {FORMAT!r} version {VERSION}, got {document.get('format')!r}: train again")
    values = {name: value for name, value in document.items() if name not in ("format", "version")}
    return _checked(TrainSettings, values | {"network": _checked(NetworkSettings, values.get("network", {}), where)}, where)


Settings = TypeVar("Settings", NetworkSettings, TrainSettings)


def _checked(kind: type[Settings], values: dict[str, Any], where: str) -> Settings:
    """The dataclass from its JSON; raises InputError where a name is unknown."""
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
