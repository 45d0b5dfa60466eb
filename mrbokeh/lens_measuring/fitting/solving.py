"""Pictures of the pupil from evidence: nowhere negative, summing to one, smooth within and near to their neighbours.

    minimise  sum over knots and colours of  1/2 q'Gq - b'q  +  tv * sum over cells sqrt(|grad q|^2 + e^2)
              + 1/2 sum over pairs of knots and of colours  tie * |q - q'|^2

q is the picture in units of an even disc's cells, so that 1 is "as bright as if all were even". Total variation lets rims be sharp where
a square would round them off. Solved by accelerated projected gradients (Beck and Teboulle 2009, restarted as O'Donoghue and Candes 2015),
each knot and colour with a step of its own, since some have a thousand times the evidence of others; projected on the simplex by sorting
(Held, Wolfe and Crowder 1974).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from mrbokeh.lens_measuring.fitting.evidence import Evidence, Knots
from mrbokeh.lens_measuring.fitting.pupil_picture import PupilGrid
from mrbokeh.system.console import track

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
