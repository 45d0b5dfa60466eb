"""How well one method did on one slice, in numbers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_metrics import energy_ratio, leak, light_error, psnr, ssim
from training.evaluation.places import edge_band, light_discs, sharp_side
from training.evaluation.unseen_slice import UnseenSlice

Image = Float32[np.ndarray, "height width 3"]
Perceptual = Callable[[Image, Image], float]


@dataclass(frozen=True)
class Score:
    """One method on one slice, over all pixels but those that moved, have no data or show a calibration board.

    psnr_db, ssim: linear radiance clipped to [0, 1]. edge_psnr_db: near depth edges. energy_ratio: light of the result over that of
    the truth, unclipped. leak: light that runs over the sharp side of depth edges, over the light of the truth there.
    highlight_error: absolute error over light, unclipped, in the discs of lights; clipped lights score high here and nowhere else.
    lpips: with weights that the user has. seconds: for the picture. nan where a slice has no such place or nothing was measured.
    """

    stack: str
    slice_index: int
    method: str
    psnr_db: float
    ssim: float
    edge_psnr_db: float = float("nan")
    energy_ratio: float = float("nan")
    leak: float = float("nan")
    highlight_error: float = float("nan")
    lpips: float = float("nan")
    seconds: float = float("nan")


MEASURES = tuple(each.name for each in fields(Score) if each.name not in ("stack", "slice_index", "method"))


class SliceScorer:
    """Scores of any number of methods on one slice, whose telling pixels are found once. lpips: distance of two linear pictures."""

    def __init__(self, seen: UnseenSlice, lpips: Perceptual | None = None) -> None:
        self._seen, self._lpips = seen, lpips
        self._edges, self._sharp, self._discs = edge_band(seen), sharp_side(seen), light_discs(seen)

    def score(self, method: str, picture: Image, seconds: float = float("nan")) -> Score:
        seen, truth, counted = self._seen, self._seen.pair.target, self._seen.counted
        shown = np.where(counted[..., None], picture, truth)  # SSIM and LPIPS want whole pictures
        plain = Score(seen.stack, seen.index, method, psnr(picture, truth, mask=counted), ssim(shown, truth), seconds=seconds)
        return replace(
            plain,
            edge_psnr_db=psnr(picture, truth, mask=self._edges) if self._edges.any() else float("nan"),
            energy_ratio=energy_ratio(picture[counted], truth[counted]),
            leak=leak(picture, truth, self._sharp),
            highlight_error=light_error(picture, truth, self._discs, seen.saturated),
            lpips=float("nan") if self._lpips is None else self._lpips(shown, truth),
        )


@dataclass(frozen=True)
class Evaluation:
    """scores: of every method on every slice. networks: which methods are networks; rivals: which are plain Gaussians.
    flicker, peak_memory_mib: by method, where they were measured."""

    scores: tuple[Score, ...]
    networks: tuple[str, ...]
    rivals: tuple[str, ...]
    flicker: dict[str, float]
    peak_memory_mib: dict[str, float]

    @property
    def methods(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(each.method for each in self.scores))

    @property
    def slices(self) -> int:
        return len({(each.stack, each.slice_index) for each in self.scores})

    def mean(self, method: str, measure: str) -> float:
        """Over the slices that have the measure; nan where none has."""
        return mean_known([getattr(each, measure) for each in self.scores if each.method == method])

    def gain_db(self, network: str, rival: str) -> float:
        return self.mean(network, "psnr_db") - self.mean(rival, "psnr_db")

    @property
    def better_gaussian(self) -> str:
        return max(self.rivals, key=lambda name: self.mean(name, "psnr_db"))


def mean_known(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")
