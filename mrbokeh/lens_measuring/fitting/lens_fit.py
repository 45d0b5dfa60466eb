"""LensFit: the kernels of a lens, measured from focal stacks and from points of light.

They are pictures of the pupil, solved from evidence: nowhere negative, summing to one, smooth within and near to their neighbours.

    minimise  sum over knots and colours of  1/2 q'Gq - b'q  +  tv * sum over cells sqrt(|grad q|^2 + e^2)
              + 1/2 sum over pairs of knots and of colours  tie * |q - q'|^2

q is the picture in units of an even disc's cells, so that 1 is "as bright as if all were even". Total variation lets rims be sharp where
a square would round them off. Solved by accelerated projected gradients (Beck and Teboulle 2009, restarted as O'Donoghue and Candes 2015),
each knot and colour with a step of its own, since some have a thousand times the evidence of others; projected on the simplex by sorting
(Held, Wolfe and Crowder 1974).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair, StackSlices, largest_diameter_px
from mrbokeh.lens_measuring.fitting.evidence import NOTHING, SIMPLEST_FIRST, Equations, Evidence, Knots, Pictures, Sharing, simplest_of
from mrbokeh.lens_measuring.fitting.point_lights import PointLight, best_scale, equations_of_light, light_count
from mrbokeh.lens_measuring.fitting.pupil_picture import PupilGrid
from mrbokeh.lens_measuring.fitting.stack_equations import (
    LEAST_DIAMETER_PX,
    SliceView,
    drawn_pixels,
    equations_of,
)
from mrbokeh.optics.aperture import Aperture
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

_SOFT = 0.02  # e: steps of brightness smaller than this are smoothed as squares would
_POWER_STEPS = 12


@dataclass(frozen=True)
class Smoothness:
    """Trust in smooth pictures, in units of evidence of noise 1.

    total_variation: within a picture. diameter, field, colour, side: one over the variance expected between cells of neighbouring knots.
    evidence: how much of a pixel's evidence counts, because neighbours err together.
    """

    total_variation: float = 0.3
    diameter: float = 3.0
    field: float = 3.0
    colour: float = 3.0
    side: float = 0.01
    evidence: float = 0.1

    def times(self, factor: float) -> "Smoothness":
        """Return all strengths times a factor."""
        names = ("total_variation", "diameter", "field", "colour", "side")
        return replace(self, **{name: factor * getattr(self, name) for name in names})

    def tied(self, factor: float) -> "Smoothness":
        """Return the ties between neighbouring knots times a factor."""
        return replace(self, diameter=factor * self.diameter, field=factor * self.field, colour=factor * self.colour)


def solve(
    evidence: Evidence, grid: PupilGrid, knots: Knots, smoothness: Smoothness, steps: int = 150
) -> Float64[np.ndarray, "knots channels cells"]:
    """Solve for the pictures of all knots and colours; knots without evidence are the mean of their neighbours."""
    told = np.flatnonzero(evidence.counts)
    problem = _Problem.of(evidence, told, grid, knots, smoothness)
    picture = np.broadcast_to(problem.start, problem.sides.shape).astype(np.float64)
    ahead, speed = picture, 1.0
    for _ in track(range(steps), "kernels"):
        new = on_simplex(ahead - problem.gradient(ahead) * problem.step, problem.total)
        if float(((ahead - new) / problem.step * (new - picture)).sum()) > 0.0:
            speed = 1.0
        faster = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * speed**2))
        ahead = new + (speed - 1.0) / faster * (new - picture)
        picture, speed = new, faster
    return _filled(picture / problem.total, told, knots)


def _filled(
    pictures: Float64[np.ndarray, "told channels cells"], told: Int64[np.ndarray, " told"], knots: Knots
) -> Float64[np.ndarray, "knots channels cells"]:
    """Fill knots without evidence from the next diameter, else place, else the other side, step by step."""
    whole, known = np.zeros((len(knots), *pictures.shape[1:])), np.zeros(len(knots), bool)
    whole[told], known[told] = pictures, True
    neighbours = knots.neighbours()
    while not known.all():
        for name in ("diameter", "field", "side"):
            pairs = np.concatenate([neighbours[name], neighbours[name][:, ::-1]])
            pairs = pairs[known[pairs[:, 0]] & ~known[pairs[:, 1]]]
            if len(pairs):
                break
        for knot in np.unique(pairs[:, 1]):
            whole[knot] = whole[pairs[pairs[:, 1] == knot, 0]].mean(axis=0)
        known[pairs[:, 1]] = True
    return whole


@dataclass(frozen=True)
class _Problem:
    matrices: Float32[np.ndarray, "knots channels cells cells"]
    sides: Float64[np.ndarray, "knots channels cells"]
    used: Bool[np.ndarray, "side side"]
    ties: list[tuple[Int64[np.ndarray, "_ 2"], float]]
    smoothness: Smoothness
    scale: float
    total: float
    start: Float64[np.ndarray, " cells"]
    step: Float64[np.ndarray, "knots channels 1"]

    @classmethod
    def of(cls, evidence: Evidence, told: Int64[np.ndarray, " told"], grid: PupilGrid, knots: Knots, smoothness: Smoothness) -> "_Problem":
        """Return the problem of the knots that have evidence."""
        matrices = evidence.matrices if len(told) == len(knots) else evidence.matrices[told]
        disc = np.hypot(*grid.places.T) <= 1.0
        total = float(disc.sum())
        scale = smoothness.evidence / total**2
        numbers = np.full(len(knots), -1)
        numbers[told] = np.arange(len(told))
        pairs_of = {name: numbers[pairs] for name, pairs in knots.neighbours().items()}
        ties = [(pairs[(pairs >= 0).all(axis=1)], getattr(smoothness, name)) for name, pairs in pairs_of.items()]
        tied = np.zeros(len(told))
        for pairs, tie in ties:
            np.add.at(tied, pairs.ravel(), 2.0 * tie)
        steepest = scale * _largest_eigenvalues(matrices)
        steepest += tied[:, None] + 2.0 * smoothness.colour + 8.0 * smoothness.total_variation / _SOFT
        sides = evidence.sides[told] * (smoothness.evidence / total)
        step = 1.0 / steepest[..., None]
        return cls(
            matrices=matrices,
            sides=sides,
            used=grid.used,
            ties=ties,
            smoothness=smoothness,
            scale=scale,
            total=total,
            start=disc.astype(np.float64),
            step=step,
        )

    def gradient(self, q: Float64[np.ndarray, "knots channels cells"]) -> Float64[np.ndarray, "knots channels cells"]:
        out = np.matmul(self.matrices, q[..., None].astype(np.float32))[..., 0] * self.scale - self.sides
        out += self._of_variation(q)
        for pairs, tie in self.ties:
            apart = tie * (q[pairs[:, 0]] - q[pairs[:, 1]])
            np.add.at(out, pairs[:, 0], apart)
            np.add.at(out, pairs[:, 1], -apart)
        return np.asarray(out + self.smoothness.colour * (q - q.mean(axis=1, keepdims=True)))

    def _of_variation(self, q: Float64[np.ndarray, "knots channels cells"]) -> Float64[np.ndarray, "knots channels cells"]:
        square = np.zeros((*q.shape[:2], *self.used.shape))
        square[..., self.used] = q
        across, down = np.zeros_like(square), np.zeros_like(square)
        across[..., :-1] = np.diff(square, axis=-1) * (self.used[:, 1:] & self.used[:, :-1])
        down[..., :-1, :] = np.diff(square, axis=-2) * (self.used[1:] & self.used[:-1])
        pull = self.smoothness.total_variation / np.sqrt(across**2 + down**2 + _SOFT**2)
        across, down = across * pull, down * pull
        out = -across - down
        out[..., 1:] += across[..., :-1]
        out[..., 1:, :] += down[..., :-1, :]
        return np.asarray(out[..., self.used])


def _largest_eigenvalues(matrices: Float32[np.ndarray, "knots channels cells cells"]) -> Float64[np.ndarray, "knots channels"]:
    """Return eigenvalues by repeated multiplication, 20 % added for what it has not reached."""
    vector = np.random.default_rng(0).standard_normal((*matrices.shape[:3], 1)).astype(np.float32)
    size = np.zeros(matrices.shape[:2])
    for _ in range(_POWER_STEPS):
        vector = np.matmul(matrices, vector)
        size = np.linalg.norm(vector[..., 0].astype(np.float64), axis=-1)
        vector = (vector / np.maximum(size, 1e-30)[..., None, None]).astype(np.float32)
    return np.asarray(1.2 * size)


def on_simplex(values: Float[np.ndarray, "*batch cells"], total: float) -> Float64[np.ndarray, "*batch cells"]:
    """Return the nearest values that are nowhere negative and sum to `total`."""
    ordered = -np.sort(-values, axis=-1)
    over = (np.cumsum(ordered, axis=-1) - total) / np.arange(1, values.shape[-1] + 1)
    last = (ordered > over).sum(axis=-1, keepdims=True) - 1
    return np.asarray(np.maximum(values - np.take_along_axis(over, last, axis=-1), 0.0))


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
    stacks: Sequence[FocalStack | BlurPair], lights: Sequence[PointLight], settings: FitSettings, frame: tuple[int, int] | None = None
) -> LensFit:
    """Find the kernels that explain slices, blurred pictures and lights. frame: width and height if there are lights only.

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
