"""Registration of a stack: one transform per slice, the model of focus breathing behind it, and registration.json.

registration.json can be read by people, and used again instead of computing the registration.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from capture.merging.registration.plane_transforms import Transform, middle_of, scale_of
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

# How far the scale between two slices may be from the model, whatever pictures say (strongly defocused ones say much).
LARGEST_DEPARTURE = 0.01
_ROUNDS = 30
_SMALLEST_SCATTER = 2e-4
_FEWEST_FOR_A_BEND = 5
FILE_NAME = "registration.json"
FORMAT = "mrbokeh-registration"
VERSION = 1
_CONVENTION = (
    "reference_from_slice takes (x, y, 1) of a slice to pixels of the reference slice; the first pixel's centre is (0.5, 0.5); "
    "a third row, where the camera has turned, is what both are divided by"
)

Pair = tuple[int, int]


@dataclass(frozen=True)
class Breathing:
    """Focus breathing: how much larger each slice shows the scene than the first one does.

    scales: magnification of each slice; only ratios count.
    source: "lens" (image distances of the thin lens) or "pictures" (a smooth curve through what was measured).
    largest_departure: how far (relative) a measured scale may be from the model.
    """

    scales: tuple[float, ...]
    source: Literal["lens", "pictures"]
    largest_departure: float = LARGEST_DEPARTURE

    def scale(self, target: int, source: int) -> float:
        """Return the scale of target_from_source."""
        return self.scales[target] / self.scales[source]

    def allows(self, pair: Pair, measured_scale: float) -> bool:
        return bool(abs(measured_scale / self.scale(*pair) - 1.0) <= self.largest_departure)


@dataclass(frozen=True)
class Registration:
    """Transforms that lay the slices of a stack on one of them.

    reference: index of the slice with the narrowest field of view; all others are enlarged to match it.
    reference_from_slice: (2, 3) per slice, or (3, 3) where the camera turned in the hand; pixel coordinates with (0.5, 0.5) at the centre
      of the first pixel.
    correlations: ECC correlation of each neighbour pair (1 is perfect, below 0.6 counts as none).
    residuals_px: per slice, the distance by which the worst of its pairs displaces a corner of the picture; None where no pair of the
      slice held and the breathing model alone has placed it.
    size_px: (width, height) of the slices.
    breathing: the model that served as prior.
    camera_moved: False where the model was kept as it is because no slice departs from it.
    """

    reference: int
    reference_from_slice: tuple[Transform, ...]
    correlations: tuple[float, ...]
    residuals_px: tuple[float | None, ...] = ()
    size_px: tuple[int, int] | None = None
    breathing: Breathing | None = None
    camera_moved: bool = True

    @property
    def scales(self) -> tuple[float, ...]:
        """Return the enlargement of each slice in its middle."""
        middle_px = middle_of(self.size_px or (0, 0))
        return tuple(scale_of(transform, middle_px) for transform in self.reference_from_slice)


def read_registration(path: Path | str, slices: int | None = None) -> Registration:
    """Read registration.json. Raises InputError if it is not a registration of so many slices."""
    document = read_json(path, "a registration")
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(f"{path}: expected format {FORMAT!r} version {VERSION}: delete the file, and merging registers the slices anew")
    try:
        registration = _registration(document)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path} is incomplete ({error!r}): delete it, and merging registers the slices anew") from None
    count = len(registration.reference_from_slice)
    if slices is not None and slices != count:
        raise InputError(f"{path} registers {count} slices, but the stack has {slices}: give the registration of a stack like this one")
    return registration


def write_registration(path: Path | str, registration: Registration) -> None:
    breathing = registration.breathing
    document = {
        "format": FORMAT,
        "version": VERSION,
        "convention": _CONVENTION,
        "size_px": registration.size_px,
        "reference": registration.reference,
        "reference_from_slice": [transform.tolist() for transform in registration.reference_from_slice],
        "correlations": registration.correlations,
        "residuals_px": registration.residuals_px,
        "camera_moved": registration.camera_moved,
        "breathing": None if breathing is None else vars(breathing),
    }
    write_json(path, document)


def breathing_of(
    count: int, measured: Mapping[Pair, float], lens_scales: Sequence[float] | None, unknown: Collection[int] = ()
) -> Breathing:
    """Return the lens's own breathing where most pairs agree with it, else one smooth curve over the slices.

    measured: scale of target_from_source of pairs (target, source).
    lens_scales: image distances of the slices; None where the lens or its focus is unknown. Lenses with internal focusing
      breathe otherwise than the thin lens.
    unknown: slices whose scale is the lens's at infinity because nobody knows their focus; pictures tell it between there and the
      farthest known focus.
    """
    if lens_scales is not None:
        scales = _filled_from_pictures(lens_scales, unknown, measured)
        lens = Breathing(tuple(float(scale / scales[0]) for scale in scales), "lens")
        known = {pair: scale for pair, scale in measured.items() if not set(pair) & set(unknown)}
        if not known or np.median([abs(scale / lens.scale(*pair) - 1.0) for pair, scale in known.items()]) <= LARGEST_DEPARTURE:
            return lens
    return _fitted(_abscissae(count, lens_scales), measured)


def _registration(document: dict[str, Any]) -> Registration:
    transforms = tuple(_transform(each) for each in document["reference_from_slice"])
    if not 0 <= document["reference"] < len(transforms):
        raise ValueError(f"reference {document['reference']} of {len(transforms)} slices")
    breathing, size_px = document["breathing"], document["size_px"]
    return Registration(
        reference=int(document["reference"]),
        reference_from_slice=transforms,
        correlations=tuple(float(each) for each in document["correlations"]),
        residuals_px=tuple(None if each is None else float(each) for each in document["residuals_px"]),
        size_px=None if size_px is None else (int(size_px[0]), int(size_px[1])),
        breathing=None if breathing is None else Breathing(**breathing | {"scales": tuple(breathing["scales"])}),
        camera_moved=bool(document["camera_moved"]),
    )


def _transform(rows: Any) -> Transform:
    matrix = np.array(rows, np.float64)
    if matrix.shape not in ((2, 3), (3, 3)) or not np.isfinite(matrix).all() or not abs(np.linalg.det(matrix[:2, :2])) > 0:
        raise ValueError(f"{rows} is no transform of 2 or 3 rows and 3 columns")
    return matrix


def _filled_from_pictures(lens_scales: Sequence[float], unknown: Collection[int], measured: Mapping[Pair, float]) -> list[float]:
    """Fill in unknown scales one after the other, by the median of their pairs with known ones; without such pairs they stay as given."""
    scales = {index: float(scale) for index, scale in enumerate(lens_scales) if index not in unknown}
    least_known = min(scales.values(), default=np.inf)
    for index in sorted(unknown):
        pairs = ((target, source, ratio) for (target, source), ratio in measured.items() if index in (target, source))
        found = [ratio * scales[s] if t == index else scales[t] / ratio for t, s, ratio in pairs if {t, s} - {index} <= scales.keys()]
        if found:
            scales[index] = float(np.clip(np.median(found), lens_scales[index], max(lens_scales[index], least_known)))
    return [scales.get(index, float(scale)) for index, scale in enumerate(lens_scales)]


def _abscissae(count: int, lens_scales: Sequence[float] | None) -> Float[np.ndarray, " slices"]:
    """Return 0 to 1: focus in dioptres as far as it is known (the log of the image distance is nearly linear in them), else the index."""
    along = np.arange(count, dtype=np.float64) if lens_scales is None else np.log(np.asarray(lens_scales, np.float64))
    if not np.ptp(along) > 0:
        along = np.arange(count, dtype=np.float64)
    return (along - along[0]) / (along[-1] - along[0] or 1.0)


def _fitted(along: Float[np.ndarray, " slices"], measured: Mapping[Pair, float]) -> Breathing:
    """Fit log scale = c_1 u + c_2 u^2 by least absolute differences (reweighted least squares)."""
    terms = np.column_stack([along**power for power in range(1, 2 + (len(along) >= _FEWEST_FOR_A_BEND))])
    if not measured:
        return Breathing((1.0,) * len(along), "pictures")
    rows = np.array([terms[target] - terms[source] for target, source in measured])
    wanted = np.log(list(measured.values()))
    weights, coefficients = np.ones(len(wanted)), np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(rows * root[:, None], wanted * root, rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(rows @ coefficients - wanted), _SMALLEST_SCATTER)
    # Uneven steps of the focus ring scatter about the curve; they are no errors.
    scatter = 1.4826 * float(np.median(np.abs(rows @ coefficients - wanted)))
    scales = tuple(float(each) for each in np.exp(terms @ coefficients))
    return Breathing(scales, "pictures", max(LARGEST_DEPARTURE, 4.0 * scatter))
