"""LensFit: the kernels of a lens, measured from focal stacks and from points of light."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from mrbokeh.lens_measuring.fitting.evidence import NOTHING, SIMPLEST_FIRST, Equations, Evidence, Knots, Pictures, Sharing, simplest_of
from mrbokeh.lens_measuring.fitting.point_lights import PointLight, best_scale, equations_of_light, light_count
from mrbokeh.lens_measuring.fitting.pupil_picture import PupilGrid
from mrbokeh.lens_measuring.fitting.solving import Smoothness, solve
from mrbokeh.lens_measuring.fitting.stack_equations import (
    LEAST_DIAMETER_PX,
    SliceView,
    StackSlices,
    drawn_pixels,
    equations_of,
    largest_diameter_px,
)
from mrbokeh.optics.aperture import Aperture
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

_ROUNDS = 2
_LEAST_PIXELS = 1000
_HELD_OUT = 6  # every so many slices one is kept for the proof
_MOST_PER_SLICE = 8000
_MOST_BYTES = 600e6
_KNOTS_AT = (0.35, 0.75)
_TIES = (1.0, 10.0, 100.0)  # how far neighbouring knots are held together: what explains slices best that are kept for the proof


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit.

    diameters_px: middles of the ranges of diameters whose shape is solved for by itself; () chooses two. regions, rings: as in
    `Knots`. smoothness: 1; more trusts pictures less. pixels: of all slices that are used. cell_px: size of a cell in the largest kernel.
    """

    diameters_px: tuple[float, ...] = ()
    regions: tuple[int, int] = (3, 3)
    rings: int = 0
    smoothness: float = 1.0
    pixels: int = 120_000
    cell_px: float = 1.0
    seed: int = 0


@dataclass(frozen=True)
class SliceScore:
    """Residuals of one slice (root mean square over the square root of radiance).

    They are those of a plain disc, of the aperture that the stack's lens states, and of the kernels found. held_out: the fit has not seen
    it.
    """

    stack: str
    index: int
    held_out: bool
    disc: float
    stated: float
    fitted: float


@dataclass(frozen=True)
class LensFit:
    """Measured kernels of a lens.

    pictures (knots, 3, cells): light through each cell of the pupil, sums to 1. largest_px: of all circles of confusion seen.
    pixels, lights (knots,): how many tell of each knot (pixels of lights count as pixels). errors (knots,): what is left of them, see
    `Evidence.errors`. sharing: which pictures are one and the same.
    """

    grid: PupilGrid
    knots: Knots
    pictures: Float64[np.ndarray, "knots channels cells"]
    largest_px: float
    pixels: Int64[np.ndarray, " knots"]
    lights: Int64[np.ndarray, " knots"]
    errors: Float64[np.ndarray, " knots"]
    scores: tuple[SliceScore, ...] = ()
    sharing: Sharing = NOTHING


def fit_lens(
    stacks: Sequence[FocalStack], lights: Sequence[PointLight], settings: FitSettings, frame: tuple[int, int] | None = None
) -> LensFit:
    """Find the kernels that explain slices and lights. frame: width and height if there are lights only.

    Raises InputError if stacks are not merged, not metric, or not blurred enough.
    """
    slices = StackSlices.of(stacks)
    size = slices.size if stacks else frame
    if size is None or not (stacks or lights):
        raise InputError("nothing to fit a lens to: give stacks, or frames with isolated lights out of focus that are not full")
    largest_px = max([largest_diameter_px(stacks), *(abs(light.diameter_px) for light in lights)])
    knots = _knots(settings, largest_px, size)
    grid = PupilGrid.for_diameter(largest_px, settings.cell_px, _most_side(len(knots)))
    fitting = _Fitting(slices=slices, lights=list(lights), grid=grid, knots=knots, settings=settings)
    pictures = fitting.even(Aperture.disc())
    for number in range(_ROUNDS):
        if number and stacks:
            fitting.rescale_lights(pictures)
        evidence = fitting.evidence(pictures, with_lights=bool(number) or not stacks)
        pictures = solve(evidence, grid, knots, Smoothness().times(settings.smoothness))
    candidates = [*fitting.shared(evidence), *fitting.tied(evidence, pictures)]
    scores = fitting.scores([candidate for _, candidate in candidates])
    chosen = simplest_of([[score.fitted for score in each] for each in scores])
    sharing, pictures = candidates[chosen]
    counts = light_count(fitting.lights, knots)
    errors = evidence.errors(pictures)
    return LensFit(
        grid=grid,
        knots=knots,
        pictures=pictures,
        largest_px=largest_px,
        pixels=evidence.counts,
        lights=counts,
        errors=errors,
        scores=scores[chosen],
        sharing=sharing,
    )


def _knots(settings: FitSettings, largest_px: float, size: tuple[int, int]) -> Knots:
    diameters = settings.diameters_px or tuple(share * largest_px for share in _KNOTS_AT)
    highs = (float(size[0] / np.hypot(*size)), float(size[1] / np.hypot(*size)))
    return Knots(diameters, settings.regions, settings.rings, highs)


def _most_side(knots: int) -> int:
    """Return the largest side of the grid whose normal equations fit into memory."""
    return int(np.sqrt(np.sqrt(_MOST_BYTES / (12.0 * knots)) / (0.25 * np.pi)))


@dataclass
class _Fitting:
    slices: StackSlices
    lights: list[PointLight]
    grid: PupilGrid
    knots: Knots
    settings: FitSettings

    def even(self, aperture: Aperture) -> Pictures:
        """Return the pictures of all knots seen through one aperture."""
        return np.broadcast_to(self.grid.of_aperture(aperture).T, (len(self.knots), 3, len(self.grid.places)))

    def held_out(self, number: int) -> bool:
        """Return whether a slice is held out: one in six, another one of each stack; none if there are fewer."""
        first = min(_HELD_OUT, self.slices.longest) - 1
        return len(self.slices) >= _HELD_OUT and sum(divmod(number, self.slices.longest)) % _HELD_OUT == first

    def shared(self, evidence: Evidence) -> list[tuple[Sharing, Pictures]]:
        """Return the pictures of every sharing, the simplest first; none without slices to judge them by."""
        if not self.holds_out:
            return []
        found, channels = [], evidence.sides.shape[1]
        for sharing in SIMPLEST_FIRST:
            merged, knots = sharing.merged(evidence, self.knots)
            pictures = solve(merged, self.grid, knots, self._smoothness)
            found.append((sharing, sharing.spread(pictures, self.knots, channels)))
        return found

    def tied(self, evidence: Evidence, pictures: Pictures) -> list[tuple[Sharing, Pictures]]:
        """Return pictures that share nothing but are tied to their neighbours, firmly first; last those given, with the weakest ties."""
        firmly = sorted((factor for factor in _TIES if factor > 1.0 and self.holds_out), reverse=True)
        made = [solve(evidence, self.grid, self.knots, self._smoothness.tied(factor)) for factor in firmly]
        return [(NOTHING, each) for each in [*made, pictures]]

    @property
    def _smoothness(self) -> Smoothness:
        return Smoothness().times(self.settings.smoothness)

    def evidence(self, pictures: Pictures, with_lights: bool) -> Evidence:
        """Sum the evidence of all slices but those held out, and of lights; weighted by how well the pictures explain it."""
        evidence = Evidence.none(len(self.knots), 3, len(self.grid.places))
        for number in track(range(len(self.slices)), "slices"):
            if not self.held_out(number) and (equations := self._equations(number)) is not None:
                evidence.add(equations, equations.robust(pictures))
        if len(self.slices) and evidence.counts.sum() < _LEAST_PIXELS:
            raise InputError(
                f"expected at least {_LEAST_PIXELS} pixels blurred by {LEAST_DIAMETER_PX:g} px or more, with trusted depth and away from "
                f"its edges, found {evidence.counts.sum()}: photograph flat, textured things at more focus distances, or larger pictures"
            )
        for light in self.lights if with_lights else []:
            equations = equations_of_light(light, self.grid, self.knots)
            evidence.add(equations, equations.weights)
        return evidence

    def rescale_lights(self, pictures: Pictures) -> None:
        """Give lights the diameters that agree with slices, whose diameters are known."""
        scales = [best_scale(light, self.grid, self.knots, pictures) for light in self.lights]
        self.lights = [replace(light, diameter_px=light.diameter_px * scale) for light, scale in zip(self.lights, scales, strict=True)]

    @property
    def holds_out(self) -> bool:
        return any(self.held_out(number) for number in range(len(self.slices)))

    def scores(self, candidates: Sequence[Pictures]) -> list[tuple[SliceScore, ...]]:
        """Return for each candidate the scores of slices that are held out, or of all if none is."""
        disc, found = self.even(Aperture.disc()), []
        for number in track(range(len(self.slices)), "proof"):
            if self.held_out(number) != self.holds_out or (equations := self._equations(number)) is None:
                continue
            stack, index = self.slices.place(number)
            stated = self.even(stack.lens.aperture.seen(1)) if stack.lens is not None else disc
            plain = (stack.folder.name, index, self.holds_out, equations.error(disc), equations.error(stated))
            found.append([SliceScore(*plain, equations.error(each)) for each in candidates])
        return [tuple(each) for each in zip(*found, strict=True)] or [() for _ in candidates]

    def _equations(self, number: int) -> Equations | None:
        """Return the equations of a slice; None if no pixel can be used."""
        view: SliceView = self.slices.view(number)
        count = min(_MOST_PER_SLICE, self.settings.pixels // len(self.slices))
        where = drawn_pixels(view, self.knots, count, np.random.default_rng((self.settings.seed, number)))
        return equations_of(view, where, self.grid, self.knots) if len(where) else None
