"""Fused pairs ranked among published methods by the four usual measures, and those measures beside published values.

Published: for each pair PAIR the fused picture of METHOD as PAIR_METHOD.jpg in lytro_pairs_fused, and in fusion_values/Q_color.mat the
values of eight measures for 18 methods, which are not named there. They are told by their values.
"""

import hashlib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.io import loadmat
from scipy.stats import rankdata

from mrbokeh.system.atomic_files import read_json, write_json
from tests.bench import fusion_measures
from tests.bench.fusion_measures import FusionScores, Picture, fusion_scores
from tests.bench.real_sets import FUSED_BY_OTHERS, PAIR_SET, PUBLISHED_VALUES, photographs_in

PUBLISHED_COLUMNS = FusionScores(2, 1, 3, 6)
"""Where the published table keeps our four measures."""
SURE, SURER = 0.7, 1.1
"""A published row is taken for a method that is this near to it, in median deviations of the published values from method to method, and
SURER times nearer than any other method is to the row, or another row to the method."""
FAR, LEAST_SPREAD = 6.0, 1e-3
"""A pair is odd where all four measures are this many median deviations off."""
OURS = "mrbokeh"

Scores = dict[str, FusionScores]


def fused_beside(folder: Path, data: Path) -> dict[str, Path]:
    """Return the fused pictures in a folder by pair: PAIR.png, or PAIR_anything.png, in any format that OpenCV reads."""
    pictures = photographs_in(folder)
    found = {
        pair.name: [path for path in pictures if path.stem == pair.name or path.stem.startswith(pair.name + "_")] for pair in pairs_in(data)
    }
    return {name: paths[0] for name, paths in found.items() if paths}


def pairs_in(data: Path) -> list[Path]:
    folder = data / PAIR_SET
    return sorted(each for each in folder.iterdir() if len(photographs_in(each)) == 2) if folder.is_dir() else []


def read_picture(path: Path) -> Picture:
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError(f"{path} is no picture that OpenCV reads")
    return Picture.of(np.ascontiguousarray(pixels[..., ::-1]))


def scores_by_others(data: Path, cache: Path) -> dict[str, Scores]:
    """Score every published fused picture, by pair and method; what was scored before by the same measures is kept in the cache."""
    kept_path = cache / "pairs_by_others.json"
    measures = hashlib.sha256(inspect.getsource(fusion_measures).encode()).hexdigest()[:16]
    kept = read_json(kept_path, "scores of fused pairs") if kept_path.is_file() else {}
    known = kept["scores"] if kept.get("measures") == measures else {}
    for pair in pairs_in(data):
        pictures = [path for path in photographs_in(data / FUSED_BY_OTHERS) if path.stem.startswith(pair.name + "_")]
        if pictures and pair.name not in known:
            sources = _sources(pair)
            known[pair.name] = {path.stem.removeprefix(pair.name + "_"): fusion_scores(*sources, read_picture(path)) for path in pictures}
            write_json(kept_path, {"measures": measures, "scores": known})
            print(f"{pair.name}: {len(pictures)} published fused pictures scored", flush=True)
    return {pair: {method: FusionScores(*scores) for method, scores in methods.items()} for pair, methods in known.items()}


def _sources(pair: Path) -> tuple[Picture, Picture]:
    first, second = (read_picture(path) for path in photographs_in(pair))
    for each in (first, second):
        each.features  # noqa: B018 - worked out once for all fused pictures
    return first, second


@dataclass(frozen=True)
class Ranking:
    """values, ranks: (pairs, methods, measures); ranks count from 1, equal values share the mean of theirs. methods: names; OURS is one."""

    pairs: tuple[str, ...]
    methods: tuple[str, ...]
    values: Float64[np.ndarray, "pairs methods measures"]
    ranks: Float64[np.ndarray, "pairs methods measures"]

    def mean_rank(self, method: str = OURS) -> float:
        """Over pairs and measures."""
        return float(self.ranks[:, self.methods.index(method)].mean())

    def rank_of_means(self, method: str = OURS) -> Float64[np.ndarray, " measures"]:
        """The rank of each measure's mean over the pairs."""
        return _ranks(self.values.mean(axis=0))[self.methods.index(method)]

    def table(self) -> list[tuple[str, float, list[float], list[float]]]:
        """(method, mean rank, mean rank by measure, mean value by measure), best first."""
        by_measure, means = self.ranks.mean(axis=0), self.values.mean(axis=0)
        rows = [(name, float(by_measure[k].mean()), list(by_measure[k]), list(means[k])) for k, name in enumerate(self.methods)]
        return sorted(rows, key=lambda row: row[1])


def rank_fused(data: Path, cache: Path, fused: Mapping[str, Path]) -> Ranking:
    """Rank fused pictures, by pair, among the published ones of those pairs."""
    others = scores_by_others(data, cache)
    pairs = [pair for pair in pairs_in(data) if pair.name in fused and pair.name in others]
    if not pairs:
        raise ValueError(f"no pair of {data / PAIR_SET} has a fused picture and published ones in {data / FUSED_BY_OTHERS}")
    return ranked({pair.name: others[pair.name] | {OURS: fusion_scores(*_sources(pair), read_picture(fused[pair.name]))} for pair in pairs})


def ranked(scores: Mapping[str, Scores]) -> Ranking:
    """Rank methods that have scores for every pair."""
    methods = tuple(sorted(set.intersection(*(set(each) for each in scores.values()))))
    values = np.array([[each[method] for method in methods] for each in scores.values()], np.float64)
    return Ranking(tuple(scores), methods, values, _ranks(values))


def _ranks(values: Float64[np.ndarray, "*batch methods measures"]) -> Float64[np.ndarray, "*batch methods measures"]:
    return rankdata(-values, axis=-2)


@dataclass(frozen=True)
class Agreement:
    """A method whose published row is known by its values. median: of our values less the published, by measure; odd: pairs far from it."""

    method: str
    row: int
    median: FusionScores
    spread: FusionScores
    odd: tuple[str, ...]


def agreements(data: Path, others: Mapping[str, Scores]) -> list[Agreement]:
    """Compare our measures of the published fused pictures with the published values, for each row that one method alone explains.

    Medians over the pairs, because the published values of a pair may be of other files than those that lie there.
    """
    path = data / PUBLISHED_VALUES / "Q_color.mat"
    if not path.is_file() or not others:
        return []
    ours = ranked(others)
    indices = [int(pair.split("_")[-1]) - 1 for pair in ours.pairs]
    published = loadmat(str(path))["Q"][:, list(PUBLISHED_COLUMNS)][..., indices].transpose(0, 2, 1)
    differences = ours.values.transpose(1, 0, 2)[:, None] - published
    apart = (np.median(np.abs(differences), axis=2) / np.median(np.abs(published - np.median(published, axis=0)), axis=(0, 1))).mean(
        axis=-1
    )
    found = []
    for row in range(len(published)):
        method = int(apart[:, row].argmin())
        others_apart = min(np.delete(apart[method], row).min(), np.delete(apart[:, row], method).min())
        if apart[method, row] > SURE or others_apart < SURER * apart[method, row]:
            continue
        each = differences[method, row]
        middle = np.median(each, axis=0)
        spread = np.median(np.abs(each - middle), axis=0)
        odd = (np.abs(each - middle) > FAR * np.maximum(spread, LEAST_SPREAD)).all(axis=1)
        names = tuple(pair for pair, far in zip(ours.pairs, odd, strict=True) if far)
        found.append(Agreement(ours.methods[method], row + 1, FusionScores(*middle), FusionScores(*spread), names))
    return found
