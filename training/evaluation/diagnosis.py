"""Diagnosis of a run: what may be wrong with it, each with its evidence and what to do.

Its curve is read from the checkpoint; the network, and the pictures where they still lie, are looked at on a few slices.
Thresholds come from runs on traced stacks that were made bad on purpose (docs/decisions/training.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mrbokeh.stacks.focal_stack import FocalStack
from training.data.pairs import WHERE_TRUTH_IS_KNOWN, Pair, counting_of, read_pair
from training.evaluation.methods import DISC, NETWORK, NO_BLUR, blur_of, disc_method, network_method, plain_methods
from training.evaluation.run_data import RunData, affordable, data_of_run, scored_on, some
from training.evaluation.scores import Evaluation
from training.fitting.checkpoint import FAR_ABOVE, CurvePoint, Progress, read_progress
from training.fitting.record import lower_rate
from training.fitting.run_folder import NETWORK_NAME, RunFacts, read_facts
from training.fitting.settings import TrainSettings, read_settings, tried_rates

_SLICES = 6
_LEAST_STEPS, _LEAST_SEEN = 300, 4.0
_LEAST_HELD_OUT = 4
_GAIN_DB, _GAP_DB, _WORTH_DB = 0.3, 1.0, 1.0
_FALL = 0.85  # of the loss over the last quarter, which the falling rate makes a little smaller in sound runs too
_FAR_FROM_PRESET = 10.0
_LIGHT, _PILE = 2.0, 5e-4
_LEAST_IN_BLURS = 4.0  # side of a tile


class Look(NamedTuple):
    """A look at one slice. largest_px: diameter; beyond: share of the pixels blurred more than the network reaches. piled: share within
    2 % of the brightest."""

    largest_px: float
    beyond: float
    brightest: float
    piled: float


@dataclass(frozen=True)
class Pictures:
    """A look at a few slices. held_out, train: scores, None without a network. left_out: share of the pixels that do not count.

    by_depth: of these, because depth is not trusted. clipped: share of the slices' pixels that are saturated.
    """

    data: RunData
    held_out: Evaluation | None
    train: Evaluation | None
    looks: tuple[Look, ...]
    left_out: float
    by_depth: float
    clipped: float


@dataclass(frozen=True)
class Case:
    """All that is known of a run; pictures is None where they are not found."""

    folder: Path
    settings: TrainSettings
    facts: RunFacts
    progress: Progress
    pictures: Pictures | None

    @property
    def looks(self) -> list[CurvePoint]:
        return [point for point in self.progress.curve if not math.isnan(point.held_out_psnr_db)]

    @property
    def seen(self) -> float:
        """Return how often each slice was seen, or nan where nobody knows how many there are."""
        return self.progress.pictures / len(self.pictures.data.train) if self.pictures else math.nan

    def more(self, times: float = 3.0) -> str:
        """Return the option for so many times the budget."""
        epochs = self.settings.epochs
        return f"--epochs {math.ceil(times * epochs)}" if epochs else f"--minutes {times * (self.settings.minutes or 1.0):g}"

    def at(self, share: float) -> CurvePoint | None:
        """Return the last point of the curve before this share of all steps."""
        return next((point for point in reversed(self.progress.curve) if point.step <= share * self.progress.step), None)


@dataclass(frozen=True)
class Diagnosis:
    """Findings, in sentences; looked: what was looked at; unseen: what could not be."""

    found: tuple[str, ...]
    looked: tuple[str, ...]
    unseen: tuple[str, ...]
    has_pictures: bool


def diagnose(folder: Path, given: Sequence[FocalStack] = ()) -> Diagnosis:
    """Diagnose a run, finished or not. given: its stacks, if they are no longer where they were. Raises InputError for another folder."""
    settings, facts = read_settings(folder), read_facts(folder)
    data = data_of_run(facts, given)
    case = Case(
        folder=folder,
        settings=settings,
        facts=facts,
        progress=read_progress(folder),
        pictures=None if data is None else _pictures(folder, settings, facts, data),
    )
    answers = {name: check(case) for name, check in _CHECKS.items()}
    return Diagnosis(
        found=tuple(answer for answer in answers.values() if answer),
        looked=tuple(name for name, answer in answers.items() if answer is not None),
        unseen=tuple(name for name, answer in answers.items() if answer is None),
        has_pictures=data is not None,
    )


def _pictures(folder: Path, settings: TrainSettings, facts: RunFacts, data: RunData) -> Pictures:
    train, held_out = some(data.train, _SLICES), some(data.held_out, _SLICES)
    scores: list[Evaluation | None] = [None, None]
    if (folder / NETWORK_NAME).is_file():
        blur = blur_of(folder)[0]
        methods = [network_method(NETWORK, blur), *plain_methods()[:1], disc_method()]
        chosen = [affordable(blur, each, _SLICES) if each else [] for each in (data.held_out, data.train)]
        scores = [scored_on(methods, each) if each else None for each in chosen]
    counting = counting_of(settings)
    left_out, whatever_depth = (
        1.0 - float(np.mean([read_pair(stack, index, each).weight.mean() for stack, index in train]))
        for each in (counting, replace(counting, least_confidence=0.0))
    )
    return Pictures(
        data=data,
        held_out=scores[0],
        train=scores[1],
        looks=tuple(
            _look(read_pair(stack, index, WHERE_TRUTH_IS_KNOWN), _covered_px(settings, facts)) for stack, index in train + held_out
        ),
        left_out=left_out,
        by_depth=left_out - whatever_depth,
        clipped=float(np.mean([stack.slice_masks(index).saturated.mean() for stack, index in train])),
    )


def _look(pair: Pair, covered_px: float) -> Look:
    diameters, light = np.abs(pair.coc_px[pair.weight > 0]), pair.all_in_focus.max(axis=2)
    beyond = float(np.mean(diameters > covered_px)) if diameters.size else 0.0
    return Look(float(diameters.max(initial=0.0)), beyond, float(light.max()), float(np.mean(light > 0.98 * light.max())))


def _covered_px(settings: TrainSettings, facts: RunFacts) -> float:
    """Return the largest diameter that the network was built for: that of the data, or its largest kernel where N was given."""
    blocks = settings.network.blocks
    return min(facts.largest_coc_px, math.inf if blocks is None else 2.0 * blocks + 1.0)


def _finished(case: Case) -> str:
    if case.progress.finished:
        return ""
    return (
        f"The run is not finished: it stopped after {case.progress.step} steps. Give the same `mrbokeh train fit` again, without "
        f"--overwrite; if it ended with an error, do what that said."
    )


def _steps(case: Case) -> str:
    step = case.progress.step
    if not step:
        return "No step was made, or none was kept: see what the run said when it ended."
    if step >= _LEAST_STEPS and not case.seen < _LEAST_SEEN:
        return ""
    seen = "" if math.isnan(case.seen) else f", in which each slice was seen {case.seen:.1f} times"
    times = max(3.0, _LEAST_STEPS / max(step, 1), 0.0 if math.isnan(case.seen) else _LEAST_SEEN / case.seen)
    return f"Too few steps: {step}{seen}; at least {_LEAST_STEPS}, and {_LEAST_SEEN:g} times, are wanted. Give {case.more(times)}."


def _falling(case: Case) -> str:
    before = case.at(0.75)
    if not case.progress.curve or before is None:
        return f"Too short to say whether it still learns: the curve has no point before its last quarter. Give {case.more()}."
    end, earlier = case.progress.curve[-1], [look for look in case.looks if look.step <= 0.75 * case.progress.step]
    gain_db = case.looks[-1].held_out_psnr_db - earlier[-1].held_out_psnr_db if earlier else math.nan
    fall = end.loss / before.loss
    if not (gain_db > _GAIN_DB or (math.isnan(gain_db) and fall < _FALL)):
        return ""
    evidence = (
        f"the loss went from {before.loss:.2e} to {end.loss:.2e}" if math.isnan(gain_db) else f"held-out slices gained {gain_db:.1f} dB"
    )
    return f"It was still learning at the end: in the last quarter {evidence}. Give {case.more()}."


def _diverged(case: Case) -> str:
    losses = [point.loss for point in case.progress.curve]
    best = min((case.progress.best_loss, *losses))
    if not (losses and losses[-1] > FAR_ABOVE * best):
        return ""
    return f"It diverged: the loss ended at {losses[-1]:.2e}, its best was {best:.2e}. Give {lower_rate(case.settings)}."


def _overfitted(case: Case) -> str | None:
    """Compare with the best look so far, and how far the network is ahead of a disc on what it learnt from and on what it did not."""
    looks, losses = case.looks, case.progress.curve
    best = max(looks, key=lambda look: look.held_out_psnr_db, default=None)
    more = "Give more scenes and viewpoints, crops (crop_px), depth_noise, or --set patience=5, which keeps the best"
    kept_best = best is not None and case.progress.kept_step == best.step
    if best is not None and not kept_best and looks[-1].held_out_psnr_db < best.held_out_psnr_db - _GAIN_DB and losses[-1].loss < best.loss:
        fell_db = best.held_out_psnr_db - looks[-1].held_out_psnr_db
        return (
            f"It overfitted: held-out slices were best at step {best.step} ({best.held_out_psnr_db:.2f} dB), then lost {fell_db:.2f} dB, "
            f"while the training loss fell from {best.loss:.2e} to {losses[-1].loss:.2e}. {more}."
        )
    if case.pictures is None or case.pictures.held_out is None or case.pictures.train is None:
        return None
    ahead, at_home = (each.gain_db(NETWORK, DISC) for each in (case.pictures.held_out, case.pictures.train))
    if at_home - ahead <= _GAP_DB or at_home < 0.0:
        return ""
    return (
        f"It learnt its pictures rather than the lens: it is {at_home:+.1f} dB over a disc of the right size on slices it learnt from, "
        f"{ahead:+.1f} dB on held-out ones. {more}."
    )


def _rate(case: Case) -> str:
    """Compare with the presets of its form, with which they were tried."""
    rate, tried = case.settings.learning_rate, tried_rates(case.settings.network.form)
    name = min(tried, key=lambda each: abs(math.log(tried[each] / rate)), default="")
    times = rate / tried.get(name, rate)
    if 1.0 / _FAR_FROM_PRESET < times < _FAR_FROM_PRESET:
        return ""
    side = f"{times:.3g} times" if times > 1.0 else f"1/{1.0 / times:.3g} of"
    return (
        f"The learning rate is too {'high' if times > 1.0 else 'low'}: {rate:g}, {side} that of the preset {name}; the loss ended at "
        f"{case.progress.smoothed_loss:.2e}. Give --set learning_rate={tried[name]:g}."
    )


def _blur(case: Case) -> str | None:
    if case.pictures is None:
        return None
    largest_px, covered_px = max(each.largest_px for each in case.pictures.looks), _covered_px(case.settings, case.facts)
    if largest_px <= 1.02 * covered_px:
        return ""
    beyond = float(np.mean([each.beyond for each in case.pictures.looks]))
    blocks = case.settings.network.blocks
    how = (
        "leave network.blocks at none" if blocks else "write the data set again (`mrbokeh capture dataset`), or train on the scene folders"
    )
    return (
        f"The pictures are blurred more than the network reaches: up to {largest_px:.1f} px, it reaches {covered_px:.1f} px, and "
        f"{beyond:.0%} of the pixels lie beyond. To learn them, {how}."
    )


def _lights(case: Case) -> str | None:
    if case.pictures is None:
        return None
    brightest = max(case.pictures.looks, key=lambda each: each.brightest)
    top, pile = brightest.brightest, brightest.piled
    if top < _LIGHT:
        cut = f"clipped there: {pile:.1%} of the pixels are within 2 % of it" if pile > _PILE else "and none is cut"
        return (
            f"No lights to learn from: the brightest pixel is {top:.2g} (white is 1), {cut}. How lights blur cannot be learnt from these; "
            f"give RAW or traced stacks with lamps, or brackets."
        )
    if case.pictures.clipped > 1e-3:
        kept = case.settings.sensor_white is not None or case.settings.saturated == "one_sided"
        return (
            "" if kept else f"{case.pictures.clipped:.1%} of the slices' pixels are saturated and left out. Give --set saturated=one_sided."
        )
    return ""


def _held_out(case: Case) -> str | None:
    if not (case.facts.held_out or case.facts.held_out_slices):
        return "Nothing is held out, so nothing tells how good the network is. Give a stack more, or name one with --held-out."
    if case.pictures is None:
        return None
    count = len(case.pictures.data.held_out)
    few = (
        f"Few held-out slices to judge by: {count}, at least {_LEAST_HELD_OUT} are wanted. Give another stack, and name it with --held-out."
    )
    return few if count < _LEAST_HELD_OUT else ""


def _counted(case: Case) -> str | None:
    if case.pictures is None:
        return None
    if case.pictures.left_out < 0.5:
        return ""
    of_all = f"{case.pictures.left_out:.0%} of the pixels do not count"
    if case.pictures.by_depth < 0.5 * case.pictures.left_out:
        return f"{of_all}: they moved, lie beyond the border, show a board or are saturated. Give other pictures of the scene."
    return (
        f"{of_all}, {case.pictures.by_depth:.0%} because depth is not trusted (least_confidence={case.settings.least_confidence:g}). Give "
        f"better depth (more views, more texture, `mrbokeh capture report` shows where), or --set least_confidence=0."
    )


def _tiles(case: Case) -> str:
    shape, blur_px = case.settings.network, case.facts.largest_coc_px
    if not shape.tile_px:
        return ""
    size = f"tiles of {shape.tile_px} px with {shape.overlap_px} px of overlap, blur up to {blur_px:.1f} px"
    if shape.tile_px < _LEAST_IN_BLURS * blur_px:
        least = math.ceil(_LEAST_IN_BLURS * blur_px)
        return f"Tiles are too small for the blur: {size}. Give --set network.tile_px={least}, or larger pictures, or no tiles (tile_px=0)."
    if shape.overlap_px < blur_px:
        return (
            f"Tiles overlap by less than the blur is wide, so that light from the next tile is missing: {size}. "
            f"Give --set network.overlap_px={math.ceil(blur_px)}."
        )
    return ""


def _better(case: Case) -> str | None:
    pictures = case.pictures
    result = None if pictures is None else pictures.held_out or pictures.train
    if result is None:
        return None
    which = "held-out" if pictures is not None and pictures.held_out else "its own"
    levels = ", ".join(f"{name} {result.mean(name, 'psnr_db'):.2f} dB" for name in (NETWORK, NO_BLUR, DISC))
    over_none, over_disc = result.gain_db(NETWORK, NO_BLUR), result.gain_db(NETWORK, DISC)
    if over_none < _WORTH_DB:
        return f"It is no better than no blur, on {result.slices} {which} slices: {levels}. It has learnt nothing that can be used."
    if over_disc > 0.0:
        return ""
    return (
        f"It is no better than a disc of the right size, on {result.slices} {which} slices: {levels}. Use a disc, or train longer if it "
        f"still learnt at the end."
    )


_CHECKS = {
    "whether it is finished": _finished,
    "steps and how often each slice was seen": _steps,
    "whether it still learnt at the end": _falling,
    "divergence": _diverged,
    "overfitting": _overfitted,
    "the learning rate": _rate,
    "the blur of the pictures against what the network reaches": _blur,
    "lights, missing or clipped": _lights,
    "the held-out slices": _held_out,
    "pixels that do not count": _counted,
    "tiles against the blur": _tiles,
    "the network against no blur and a disc of the right size": _better,
}
