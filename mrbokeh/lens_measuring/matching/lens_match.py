"""A Lens from one photograph: its out-of-focus lights give the opening, its metadata the rest.

The size of the discs gives the focus distance, the effective f-number, where the lights are, or a bound of these:
`optics.lens.Lens.coc_px` solved the other way.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.lens_measuring.matching.discs import LEAST_DIAMETER_PX, Disc, find_discs
from mrbokeh.lens_measuring.matching.openings import FEWEST_DISCS, BladeChoice, MeanOutline, choose_opening, mean_outline, rim_light
from mrbokeh.lens_measuring.matching.openings import FEWEST_DISCS as FEWEST_ALIKE
from mrbokeh.lens_measuring.matching.photo_facts import PhotoFacts
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.system.errors import InputError


def focus_from_size(lens: Lens, coc_px: float, depth_m: float, image_width_px: int) -> float:
    """Return the focus distance at which a point at `depth_m` (inf is allowed) blurs to the signed diameter `coc_px`.

    With A the opening's diameter and c the blur's, both in the same unit, c = A f (1/s - 1/d) / (1 - f/s), so that
    1/s = (c + A f / d) / (f (A + c)). lens: its own focus distance does not matter.
    """
    focal_m, opening_m = lens.focal_length_mm / MM_PER_M, lens.aperture_diameter_mm / MM_PER_M
    blur_m = coc_px * lens.sensor_width_mm / MM_PER_M / image_width_px
    dioptres = (blur_m + opening_m * focal_m / depth_m) / (focal_m * (opening_m + blur_m))
    if opening_m + blur_m <= 0.0 or not 0.0 <= dioptres < 1.0 / focal_m:
        raise InputError(
            f"no focus {'nearer' if coc_px > 0 else 'farther'} than points at {depth_m:g} m blurs them to {abs(coc_px):.1f} px "
            f"with this lens: check --light-distance, --side and the f-number"
        )
    return 1.0 / dioptres if dioptres > 0.0 else float(np.inf)


def effective_f_number(lens: Lens, coc_px: float, depth_m: float, image_width_px: int) -> float:
    """Return the f-number that gives blur of this size at a depth; blur is as large as the opening, the focal length over the f-number."""
    expected_px = float(lens.coc_px(depth_m, image_width_px))
    if expected_px * coc_px <= 0.0:
        raise InputError(
            f"lights at {depth_m:g} m are {'behind' if expected_px > 0 else 'in front of'} a focus at {lens.focus_distance_m:g} m, but "
            f"discs of the other side were asked for: check --light-distance, --focus and --side"
        )
    return lens.f_number * expected_px / coc_px


def depth_from_size(lens: Lens, coc_px: float, image_width_px: int) -> float:
    """Return the depth at which points blur to a signed diameter, infinite or negative beyond infinity."""
    dioptres = 1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(image_width_px)
    return 1.0 / dioptres if dioptres != 0.0 else float(np.inf)


EDGE_PX, FULL_EDGE_PX = 0.15, 0.6
"""Error that all diameters share. If light L is clipped at 1, the contour at one half lies where a pixel is covered by
0.5 / L: up to half a pixel too far out on each side, on average over all L a quarter."""


@dataclass(frozen=True)
class Sizes:
    """Facts that the size of the discs gives.

    f_number and focus_distance_m: for the lens file. Errors: standard, None if the value is as stated or unknown.
    focus_known: False if focus_distance_m only stands for the lights being far off. note: what was made of the sizes, for people.
    """

    f_number: float
    f_number_error: float | None
    stated_f_number: float
    focus_distance_m: float
    focus_error_m: float | None
    focus_known: bool
    diameter_px: float
    diameter_error_px: float
    note: str


def size_facts(
    facts: PhotoFacts,
    diameters_px: Float64[np.ndarray, " discs"],
    side: int,
    depth_m: float | None,
    image_width_px: int,
    full: bool = False,
) -> Sizes:
    """Derive focus and f-number from the size of the discs.

    diameters_px: of the unit pupil. depth_m: of the lights. facts: all but the focus distance must be known.
    full: whether the light of most discs is beyond what the file can hold.
    """
    if depth_m is not None and not depth_m > 0.0:
        raise InputError(f"expected --light-distance above 0 (inf is allowed), got {depth_m:g}")
    facts.require("the photograph")
    diameter = float(np.median(diameters_px))
    error = float(np.hypot(1.2533 * diameters_px.std() / np.sqrt(len(diameters_px)), FULL_EDGE_PX if full else EDGE_PX))
    stated = Lens(
        float(facts.focal_length_mm or 0.0),
        float(facts.f_number or 0.0),
        facts.focus_distance_m or np.inf,
        float(facts.sensor_width_mm or 0.0),
    )

    def made(f_number: float, f_error: float | None, focus_m: float, focus_error_m: float | None, known: bool, note: str) -> Sizes:
        return Sizes(
            f_number=f_number,
            f_number_error=f_error,
            stated_f_number=stated.f_number,
            focus_distance_m=focus_m,
            focus_error_m=focus_error_m,
            focus_known=known,
            diameter_px=diameter,
            diameter_error_px=error,
            note=note,
        )

    if facts.focus_distance_m is not None and depth_m is not None:
        f_number, f_error = _with_error(lambda size: effective_f_number(stated, side * size, depth_m, image_width_px), diameter, error)
        return made(f_number, f_error, facts.focus_distance_m, None, True, f"effective f-number from lights at {depth_m:g} m")
    if depth_m is not None:
        focus_m, focus_error = _with_error(lambda size: focus_from_size(stated, side * size, depth_m, image_width_px), diameter, error)
        return made(stated.f_number, None, focus_m, focus_error, True, f"focus from lights at {depth_m:g} m and the stated f-number")
    if facts.focus_distance_m is not None:
        return made(stated.f_number, None, facts.focus_distance_m, None, True, _lights_at(stated, side * diameter, image_width_px))
    far_m = focus_from_size(stated, diameter, np.inf, image_width_px) if side > 0 else np.inf
    bound = f"at most {far_m:.3g} m, which the lens file holds (lights far away)" if side > 0 else "the lens file holds infinity"
    return made(stated.f_number, None, far_m, None, False, f"focus unknown, {bound}: give --light-distance or --focus")


def _with_error(value: Callable[[float], float], at: float, error: float) -> tuple[float, float]:
    """Return a value and its error: the slope over a thousandth, times the standard error."""
    here, step = value(at), 1e-3 * at
    return here, abs(value(at - step) - here) / step * error if np.isfinite(here) else 0.0


def _lights_at(lens: Lens, coc_px: float, image_width_px: int) -> str:
    """Say where the lights are by the stated f-number, or how far it is off if they would have to be beyond infinity."""
    depth_m = depth_from_size(lens, coc_px, image_width_px)
    if depth_m > 0.0:
        return f"the stated f-number has the lights at {depth_m:.3g} m; give --light-distance for the effective one"
    largest_px = float(lens.coc_px(np.inf, image_width_px))
    return (
        f"discs are larger than f/{lens.f_number:g} makes them even far away: the effective f-number is at most "
        f"{lens.f_number * largest_px / coc_px:.3g}; give --light-distance"
    )


MOST_DISCS = 60
_UNKNOWN = {"cat_eye": 0.15, "squeeze": 0.1}  # standard errors from which a value is not known
_NEUTRAL = {"cat_eye": 0.0, "squeeze": 1.0}
_HELP = (
    "take a photograph with small bright lights on dark surroundings well out of focus (night, lights at least 10 px wide and apart from "
    "each other), spread over the frame"
)


@dataclass(frozen=True)
class LensMatch:
    """Lens that was found, and its evidence.

    side: +1 if the discs were taken to lie behind the focus, -1 in front. found: all discs; discs: those that agree.
    choice: the fit of openings with blades; mean: in place of it if it is poor. own: centre and radius of the unit pupil of each of
    `discs`, px. rim: (spherical_aberration, standard error), None if no disc tells. unknown: "cat_eye" and "squeeze" if the
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
    """Find the lens of a photograph.

    rgb: scene-linear. depth_m: where the lights are; inf is allowed. largest_value: what the file can hold at most.
    Raises InputError if fewer than 3 discs are found, or those found do not look alike.
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
        focal_length_mm=float(facts.focal_length_mm or 0.0),
        f_number=sizes.f_number,
        focus_distance_m=sizes.focus_distance_m,
        sensor_width_mm=float(facts.sensor_width_mm or 0.0),
        aperture=_aperture(choice, mean, unknown, rim),
    )
    return LensMatch(
        lens=lens, side=side, found=found, discs=discs, own=own, choice=choice, mean=mean, rim=rim, unknown=unknown, sizes=sizes
    )


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
    """Return the aperture; an aberration within twice its error of none is left out, as is what no disc tells."""
    aberration = rim[0] if rim is not None and abs(rim[0]) > 2.0 * rim[1] else 0.0
    if mean is not None:
        return Aperture(mean.aperture.outlines, mean.aperture.weights, 0.0, aberration)
    return replace(choice.fit.opening, **{name: _NEUTRAL[name] for name in unknown}).aperture(aberration)  # type: ignore[arg-type]
