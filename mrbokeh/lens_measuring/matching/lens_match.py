"""A Lens from one photograph: its out-of-focus lights give the opening, its metadata the rest."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.lens_measuring.matching.blade_choice import FEWEST_DISCS, BladeChoice, choose_opening
from mrbokeh.lens_measuring.matching.discs import LEAST_DIAMETER_PX, Disc, find_discs
from mrbokeh.lens_measuring.matching.mean_outline import FEWEST_DISCS as FEWEST_ALIKE
from mrbokeh.lens_measuring.matching.mean_outline import MeanOutline, mean_outline
from mrbokeh.lens_measuring.matching.photo_facts import PhotoFacts
from mrbokeh.lens_measuring.matching.rim_light import rim_light
from mrbokeh.lens_measuring.matching.sizes import Sizes, size_facts
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

MOST_DISCS = 60
_UNKNOWN = {"cat_eye": 0.15, "squeeze": 0.1}  # standard errors from which a value is not known
_NEUTRAL = {"cat_eye": 0.0, "squeeze": 1.0}
_HELP = (
    "take a photograph with small bright lights on dark surroundings well out of focus (night, lights at least 10 px wide and apart from "
    "each other), spread over the frame"
)


@dataclass(frozen=True)
class LensMatch:
    """side: +1 where the discs were taken to lie behind the focus, -1 in front. found: all discs; discs: those that agree.
    choice: the fit of openings with blades; mean: in place of it where it is poor. own: centre and radius of the unit pupil of each of
    `discs`, px. rim: (spherical_aberration, standard error), None where no disc tells. unknown: "cat_eye" and "squeeze" where the
    discs do not tell them (they have their neutral values in the lens).
    """

    lens: Lens
    side: int
    found: tuple[Disc, ...]
    discs: tuple[Disc, ...]
    own: Float64[np.ndarray, "discs 3"]
    choice: BladeChoice
    mean: MeanOutline | None
    rim: tuple[float, float] | None
    unknown: frozenset[str]
    sizes: Sizes


def match_lens(
    rgb: Float32[np.ndarray, "height width 3"],
    facts: PhotoFacts,
    *,
    side: int = 1,
    depth_m: float | None = None,
    largest_value: float = np.inf,
) -> LensMatch:
    """rgb: scene-linear. depth_m: where the lights are; inf is allowed. largest_value: what the file can hold at most.

    Raises InputError where fewer than 3 discs are found, or those found look alike in no way.
    """
    grey = rgb.max(axis=2)
    found = _enough(find_discs(grey, largest_value))
    choice = choose_opening(found, side)
    mean = mean_outline(found, side) if choice.is_poor else None
    if choice.is_poor and mean is None:
        raise InputError(
            f"found {len(found)} bright spots, but {FEWEST_ALIKE} or more of them, and two in five, would have to fit one opening with "
            f"blades (they are off by {np.median(choice.fit.relative_rms):.0%} of their radius) or look alike: {_HELP}"
        )
    discs = choice.discs if mean is None else mean.discs
    own = choice.fit.own if mean is None else np.array([[*d.centroid_px, r] for d, r in zip(mean.discs, mean.radius_px, strict=True)])
    rim = rim_light(grey, discs, own, side)
    unknown = frozenset(name for name, error in _UNKNOWN.items() if choice.fit.errors[name] > error)
    mostly_full = 2 * sum(disc.full for disc in discs) > len(discs)
    sizes = size_facts(facts, 2.0 * own[:, 2], side, depth_m, grey.shape[1], mostly_full)
    lens = Lens(
        float(facts.focal_length_mm or 0.0),
        sizes.f_number,
        sizes.focus_distance_m,
        float(facts.sensor_width_mm or 0.0),
        _aperture(choice, mean, unknown, rim),
    )
    return LensMatch(lens, side, found, discs, own, choice, mean, rim, unknown, sizes)


def _enough(found: list[Disc]) -> tuple[Disc, ...]:
    if len(found) < FEWEST_DISCS:
        raise InputError(
            f"expected at least {FEWEST_DISCS} out-of-focus lights (bright even discs of {LEAST_DIAMETER_PX:g} px or more with sharp "
            f"edges, apart from each other and the border), found {len(found)}: {_HELP}"
        )
    largest_first = sorted(found, key=lambda disc: -disc.radius_px)
    middle = float(np.median([disc.radius_px for disc in found]))
    return tuple([disc for disc in largest_first if disc.radius_px < 3.0 * middle][:MOST_DISCS])


def _aperture(choice: BladeChoice, mean: MeanOutline | None, unknown: frozenset[str], rim: tuple[float, float] | None) -> Aperture:
    """An aberration within twice its error of none is left out, as is what no disc tells."""
    aberration = rim[0] if rim is not None and abs(rim[0]) > 2.0 * rim[1] else 0.0
    if mean is not None:
        return Aperture(mean.aperture.outlines, mean.aperture.weights, 0.0, aberration)
    return replace(choice.fit.opening, **{name: _NEUTRAL[name] for name in unknown}).aperture(aberration)  # type: ignore[arg-type]
