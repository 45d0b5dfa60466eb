"""Scores of one method on one slice, and LPIPS (Zhang et al. 2018) with weights that the user has.

No weights are shipped: LPIPS's networks were trained on ImageNet photographs and its weights come under terms of their own; and it was
made for small 8-bit pictures, so that it cannot see blurred highlights above white. With the package `lpips` installed elsewhere, a
file is made by torch.onnx.export(lpips.LPIPS(net="alex"), (a, b), "lpips.onnx") with free height and width.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.image_metrics import energy_ratio, leak, light_error, psnr, ssim
from mrbokeh.renderers.onnx_sessions import open_session
from mrbokeh.system.errors import InputError
from training.evaluation.unseen_slice import UnseenSlice, edge_band, highlight_discs, sharp_side

Image = Float32[np.ndarray, "height width 3"]
Perceptual = Callable[[Image, Image], float]
NOT_MEASURED = "LPIPS is not measured: no weights are shipped (see --lpips)."


@dataclass(frozen=True)
class Score:
    """Scores of one method on one slice, over all pixels but those that moved, have no data or show a calibration board.

    psnr_db, ssim: linear radiance clipped to [0, 1]. edge_psnr_db: near depth edges. energy_ratio: light of the result over that of
    the truth, unclipped. leak: light that spills over the sharp side of depth edges, over the light of the truth there.
    highlight_error: absolute error over light, unclipped, in the discs of highlights; clipped highlights score high here and nowhere else.
    lpips: with weights that the user has. seconds: for the picture. nan if a slice has no such place or nothing was measured.
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
    """A scorer of any number of methods on one slice, whose masks are computed once. lpips: distance of two linear pictures."""

    def __init__(self, seen: UnseenSlice, lpips: Perceptual | None = None) -> None:
        self._seen, self._lpips = seen, lpips
        self._edges, self._sharp, self._discs = edge_band(seen), sharp_side(seen), highlight_discs(seen)

    def score(self, method: str, picture: Image, seconds: float = float("nan")) -> Score:
        seen, truth, counted = self._seen, self._seen.pair.target, self._seen.counted
        shown = np.where(counted[..., None], picture, truth)  # SSIM and LPIPS want whole pictures
        plain = Score(
            stack=seen.stack,
            slice_index=seen.index,
            method=method,
            psnr_db=psnr(picture, truth, mask=counted),
            ssim=ssim(shown, truth),
            seconds=seconds,
        )
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
    """The scores of every method on every slice.

    networks: names of methods that are networks; rivals: those that are plain Gaussians.
    flicker, peak_memory_mib: by method, if they were measured.
    """

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
        """Average over the slices that have the measure; nan if none has."""
        return mean_known([getattr(each, measure) for each in self.scores if each.method == method])

    def gain_db(self, network: str, rival: str) -> float:
        return self.mean(network, "psnr_db") - self.mean(rival, "psnr_db")

    @property
    def better_gaussian(self) -> str:
        return max(self.rivals, key=lambda name: self.mean(name, "psnr_db"))


def mean_known(values: Sequence[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


class OnnxPerceptualDistance:
    """The distance of two linear pictures by a network (.onnx) that maps two (1, 3, H, W) sRGB pictures in [-1, 1] to a number."""

    def __init__(self, path: Path) -> None:
        if not path.is_file() or path.suffix.lower() != ".onnx":
            raise InputError(f"expected the weights of LPIPS as an .onnx file, got {path}: export them from the package lpips")
        self._session = open_session(path, providers=["cpu"])
        self._inputs = [each.name for each in self._session.get_inputs()]
        if len(self._inputs) != 2:
            raise InputError(f"expected {path} to take two pictures, but it takes {self._inputs}: export LPIPS with its two inputs")

    def __call__(self, result: Image, truth: Image) -> float:
        pictures = (encoded(result), encoded(truth))
        return float(np.squeeze(self._session.run(None, dict(zip(self._inputs, pictures, strict=True)))[0]))


def encoded(rgb: Image) -> Float32[np.ndarray, "1 3 height width"]:
    """Encode as sRGB for display, radiance clipped to [0, 1], mapped to [-1, 1]."""
    display = 2.0 * linear_to_srgb(np.clip(rgb, 0.0, 1.0)) - 1.0
    return np.ascontiguousarray(display.transpose(2, 0, 1)[None]).astype(np.float32)
