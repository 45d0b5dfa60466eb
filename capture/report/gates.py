"""Gates: what a stack must reach to be trusted, each with its number, its limit, the reason and the remedy; and the rules for one stack.

Limits were set between what right stacks reach and what faulty ones show (tests/views/test_reblur.py): on traced stacks with truth the
fit of a right one finds focus within 0.1 px, blur within 1 %, place within 0.03 px and exposure within 0.1 %. A tenth of f-number too
much reads as 9.6 % of blur. The merged stacks of the demo's desk, which are right, read focus within 0.3 px and -1.4 to +0.8 % of blur with
calibrated focus, but -3.3 to -3.5 % before calibration and second pass: blur that merging leaves in the all-in-focus picture, and depth
from focus. 7 % leaves twice that, and is below a tenth.

The gates that need no lens were set on 14 real stacks. Registered slices, measured where both are sharp, lie 0.0 to 0.6 px apart
(standard errors 0.01 to 0.4); those of a phone held by hand 1.4 px at a width of 1600. 1 px tells them apart, and is what one sees at 100%.
Between slices of 62 real stacks, most of them light fields, what lies midway is blurred by 0.1 to 1.4 % of the width, and by less than
0.5 % (5 px of 1080, which one sees at 100%) in 50 of them.
Where too little is sharp in both, what is left is how far pairs of the registration disagree at a corner: at most 0.17% of the width on 30
stacks from a light field camera, whose slices cannot move, and 0.25% on others, but 0.4% on one of these whose slices were put 1% apart.
Things of some size, blurred as well, lie up to 0.7% of the width apart on 40 stacks in which no camera moved; on three from a hand that
moved sideways, with ghosts and doubled things, 0.84, 2 and 3.9%.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from capture.merging.ghosts import UNLIKE
from capture.report.picture_sharpness import KEPT_DETAIL

LARGEST_LOST = 0.002
LARGEST_FLAT = 1.1
LARGEST_UNLIKE = 0.0005
LARGEST_TOP = 1.5
LARGEST_APART_PX = 1.0
LARGEST_APART = 5e-4
LARGEST_PAIR_RESIDUAL = 3e-3
LARGEST_PARALLAX = 8e-3
LEAST_DB = 30.0
LARGEST_FOCUS_PX = 0.6
LARGEST_BLUR_GAIN = 0.07
LARGEST_SHIFT_PX = 0.3
LARGEST_EXPOSURE = 0.01
LARGEST_GAIN_DRIFT = 0.02
DEPTH_OFF_PX = 1.0
LARGEST_DEPTH_SHARE = 0.05
LARGEST_MOVING = 0.02
LARGEST_SATURATED = 0.02
LARGEST_BEYOND = 0.25
LARGEST_MIDWAY = 0.005
LEAST_CORRELATION = 0.8
LARGEST_JUMP = 0.01
LEAST_TRUSTED = 0.2
NO_BLOCKS = "the pictures are too small or too even to have blocks that tell: merge larger ones"
NO_PREDICTION = "needs a merged stack with lens and focus distances: add them to lens.toml, ingest and merge again"


class Verdict(StrEnum):
    """Verdict of a gate. absent: what the gate looks at is not there (yet), which neither passes nor fails."""

    PASSED = "passed"
    FAILED = "failed"
    ABSENT = "absent"


@dataclass(frozen=True)
class Gate:
    """Answer to one question about a stack or scene.

    name: short. where: the stack, or "scene". measured: the number as text with its unit. value: the number, None where absent.
    limit: what was wanted, as text. why: why it matters. advice: what to do where it fails, or to bring about what is absent.
    """

    name: str
    where: str
    verdict: Verdict
    measured: str
    value: float | None
    limit: str
    why: str
    advice: str

    @property
    def failed(self) -> bool:
        return self.verdict is Verdict.FAILED

    def as_json(self) -> dict[str, Any]:
        return vars(self) | {"verdict": str(self.verdict), "value": finite(self.value)}


@dataclass(frozen=True)
class Rule:
    """Question that a gate asks of every stack; `judge` makes gates of it."""

    name: str
    limit: str
    why: str
    advice: str

    def judge(self, where: str, value: float, measured: str, passed: bool) -> Gate:
        return Gate(
            name=self.name,
            where=where,
            verdict=Verdict.PASSED if passed else Verdict.FAILED,
            measured=measured,
            value=value,
            limit=self.limit,
            why=self.why,
            advice=self.advice,
        )

    def absent(self, where: str, missing: str) -> Gate:
        """Return a gate that was not judged. missing: what is not there and how to make it."""
        return Gate(
            name=self.name,
            where=where,
            verdict=Verdict.ABSENT,
            measured=missing,
            value=None,
            limit=self.limit,
            why=self.why,
            advice=self.advice,
        )


def failed(gates: Sequence[Gate]) -> list[Gate]:
    return [each for each in gates if each.failed]


def absent(gates: Sequence[Gate]) -> list[Gate]:
    return [each for each in gates if each.verdict is Verdict.ABSENT]


def tally(gates: Sequence[Gate]) -> str:
    """Say how many were judged, how many of them failed, and the names of those that were not."""
    names = absent_names(gates)
    return f"{counts(gates)}: {names}" if names else counts(gates)


def absent_names(gates: Sequence[Gate]) -> str:
    missing = Counter(each.name for each in absent(gates))
    return ", ".join(name if count == 1 else f"{name} ({count} times)" for name, count in missing.items())


def verdict_lines(gates: Sequence[Gate]) -> list[str]:
    """Return a line for each gate that failed, with what to do, and one for each reason why some were not judged."""
    lines = [f"failed: {each.where}: {each.name}: {each.measured} (wanted: {each.limit}). {each.advice}" for each in failed(gates)]
    reasons: dict[str, list[str]] = {}
    for each in absent(gates):
        names = reasons.setdefault(each.measured, [])
        if each.name not in names:
            names.append(each.name)
    return [*lines, *(f"absent: {', '.join(names)}: {reason}" for reason, names in reasons.items())]


def counts(gates: Sequence[Gate]) -> str:
    missing = len(absent(gates))
    return f"{len(gates) - missing} of {len(gates)} gates judged, {len(failed(gates))} failed, {missing} absent"


def exact(value: float | None) -> float | str | None:
    """Write a number for JSON, which has neither nan nor infinity: what is not finite becomes a word that `float` reads."""
    return value if value is None or abs(value) < float("inf") else str(float(value))


def finite(value: float | None) -> float | None:
    """Write a number for JSON: null for what is not finite."""
    return value if value is not None and abs(value) < float("inf") else None


SHARP = Rule(
    "as sharp as its slices",
    f"at most {LARGEST_LOST:.1%} of the textured blocks with less than {KEPT_DETAIL:.0%} of the detail of their sharpest slice",
    "What is sharp in a slice and not in the all-in-focus picture was lost by merging.",
    "Look at the crops. Where slices do not match there (movement, wind), leave out the slice; where one slice shows the place as it "
    "should be, put it in by hand (`mrbokeh capture merge STACK --from-slice K --mask FILE`); else merge again with --overwrite.",
)


SEAMS = Rule(
    "no seams",
    f"95% of the flat blocks with at most {LARGEST_FLAT:g} times the detail of their sharpest slice",
    "Detail that no slice has comes from borders between slices of different tint or brightness, or from noise.",
    "Look at the crops. Lock exposure and white balance, avoid flickering lamps; merge again with --overwrite, or put one slice over a "
    "seam by hand (`mrbokeh capture merge STACK --from-slice K --mask FILE`).",
)


GHOSTS = Rule(
    "no ghosts",
    f"at most {LARGEST_UNLIKE:.2%} of the picture more than {UNLIKE:.0%} of white away from every slice",
    "A mixture of slices that do not match shows what was never there: things half there, or twice.",
    "Look at the crops: something moved, or the camera did. Leave out a slice, take a tripod and a moment without wind, or put one slice "
    "over the place by hand (`mrbokeh capture merge STACK --from-slice K --mask FILE`).",
)


LIGHT = Rule(
    "no invented light",
    f"nothing brighter than {LARGEST_TOP:g} times the largest value of the slices, or than the measured flux of a disc supports",
    "A lamp that no slice shows becomes a bright disc in every picture that is blurred anew.",
    "Look at the crops: a lamp whose discs are clipped in all slices needs a shorter exposure; else merge again with --overwrite.",
)


PLACES = Rule(
    "registration residual",
    f"neighbouring slices within {LARGEST_APART_PX:g} px ({LARGEST_APART:.2%} of widths beyond {LARGEST_APART_PX / LARGEST_APART:.0f} px) "
    f"where both are sharp, else pairs that agree within {LARGEST_PAIR_RESIDUAL:.1%} of the width; all things, blurred or not, within "
    f"{LARGEST_PARALLAX:.1%} of it",
    "Where slices do not lie on one another, edges are doubled and depth is wrong.",
    "Look at the two slices: a camera that moved sideways shows another view; use a tripod, or leave out the slice and merge again.",
)


SPACING = Rule(
    "no slice missing",
    "even steps in dioptres, each once and in order",
    "What lies in focus between two distant slices is sharp in neither, and may keep some blur in the all-in-focus picture.",
    "Photograph the missing distances again, or correct focus_distances_m in lens.toml if the photographs are there.",
)


RANGE = Rule(
    "focus reaches the whole scene",
    f"at most {LARGEST_BEYOND:.0%} of the picture sharpest at either end of the stack",
    "What lies beyond the first or last focus is never sharp, and its depth is cut off there.",
    "Add slices at the near or far end (`mrbokeh capture plan` says where).",
)


TEXTURE = Rule(
    "depth is known",
    f"at least {LEAST_TRUSTED:.0%} of the picture with confidence 0.3 or more",
    "Where nothing has texture, depth is a guess from its neighbours and teaches nothing.",
    "Choose scenes with texture, or add viewpoints and run `mrbokeh capture depth`.",
)


REGISTRATION = Rule(
    "registration held",
    f"correlation of neighbours at least {LEAST_CORRELATION:g}, no jump beyond {LARGEST_JUMP:.0%} of the width",
    "A pair of slices that does not correlate was placed by the lens model alone, or wrongly; a camera that was pushed sees another view.",
    "Look at the two slices: smaller focus steps, a tripod, no wind; merge again with --overwrite.",
)


EXPOSURE = Rule(
    "exposure is constant",
    f"slices within {LARGEST_EXPOSURE:.0%} of the prediction ({LARGEST_GAIN_DRIFT:.0%} where there is none)",
    "A slice that is brighter teaches the lens to make light.",
    "Lock exposure and white balance, avoid flickering lamps; leave the slice out or photograph it again.",
)


RESIDUAL = Rule(
    "re-blurred picture is the slice",
    f"PSNR at least {LEAST_DB:g} dB in every slice",
    "The all-in-focus picture, blurred by the circles of confusion, must give each photograph: this proves depth, focus and lens at once.",
    "Read the gates below, which say what is wrong with the worst slices; the difference pictures show where.",
)


FOCUS = Rule(
    "focus is right",
    f"circles of confusion within {LARGEST_FOCUS_PX:g} px in every slice",
    "A focus distance that is off, or a slice at another's place, gives the network blur of the wrong size.",
    "Correct focus_distances_m (or the order of the slices); `mrbokeh capture depth` calibrates them.",
)


BLUR = Rule(
    "blur has the right size",
    f"within {LARGEST_BLUR_GAIN:.0%} over the stack",
    "Focal length, f-number, sensor width or the scale of depth are off when all blur is too small or too large.",
    "Check f_number, focal_length_mm and sensor_width_mm in lens.toml, and the scale (`mrbokeh capture scale`).",
)


PLACE = Rule(
    "slices lie on the picture",
    f"within {LARGEST_SHIFT_PX:g} px, also in the corners",
    "A shift looks like blur to the one side, and training learns it.",
    "Merge again with --overwrite; check that nothing shook the tripod.",
)


DEPTH = Rule(
    "depth agrees with the slices",
    f"at most {LARGEST_DEPTH_SHARE:.0%} of the picture off by more than {DEPTH_OFF_PX:g} px of blur",
    "Wrong depth gives blur of the wrong size there, whatever the lens.",
    "Run `mrbokeh capture depth` over several viewpoints, or leave it to the exclusion masks if it is little.",
)


MOTION = Rule(
    "nothing moved",
    f"at most {LARGEST_MOVING:.0%} of the picture",
    "What moved is at one place in the all-in-focus picture and at another in the slice.",
    "Photograph again without wind and people, or train with exclusion masks (`mrbokeh capture dataset` writes them).",
)


SATURATION = Rule(
    "highlights are not clipped",
    f"at most {LARGEST_SATURATED:.0%} of any slice saturated",
    "Clipped highlights give bokeh discs that are too dark, the most visible part of the blur.",
    "Expose so that the brightest lights just fit where they are out of focus.",
)


SOLVED_SPACING = replace(
    SPACING,
    limit=f"what lies midway between the focus of two slices blurred by at most {LARGEST_MIDWAY:.1%} of the width",
    advice="Take the photographs that lie between these two into the stack, or refocus only where slices are near each other.",
)


SOLVED_FOCUS = replace(
    FOCUS,
    advice="Focus was solved from the slices, as not all of it is stated: it errs where blur is large or texture is missing. "
    "Refocus between slices that are right, or state focus_distances_m in lens.toml and merge again.",
)


SOLVED_BLUR = replace(
    BLUR,
    why="Blur was solved from the slices; all of it is too small or too large where the all-in-focus picture is not sharp.",
    advice="Look at the crops of the first gates; smaller focus steps make the all-in-focus picture sharper.",
)


STACK_RULES = (
    SHARP,
    SEAMS,
    GHOSTS,
    LIGHT,
    PLACES,
    SPACING,
    RANGE,
    TEXTURE,
    REGISTRATION,
    SATURATION,
    EXPOSURE,
    RESIDUAL,
    FOCUS,
    BLUR,
    PLACE,
    DEPTH,
    MOTION,
)


PICTURES = "all-in-focus pictures"
PICTURE_RULES = (SHARP, SEAMS, GHOSTS, LIGHT)
"""Rules of the all-in-focus picture: a report that lacks a verdict on one of them is not passed."""


def by_use(gates: Sequence[Gate]) -> dict[str, list[Gate]]:
    """Return the gates of the all-in-focus pictures, and the others: a picture can be flawless though its depth is no good for training."""
    names = [rule.name for rule in (*PICTURE_RULES, PLACES)]
    uses = {
        PICTURES: [each for each in gates if each.name in names],
        "depth and blur, for refocusing and training": [each for each in gates if each.name not in names],
    }
    return {use: of_use for use, of_use in uses.items() if of_use}


def verdict_line(use: str, gates: Sequence[Gate]) -> str:
    """Return one line: which gates passed, which failed and which were not judged. One that failed in some places passed in none."""
    failing = {each.name for each in failed(gates)}
    counts_of = Counter(each.name for each in gates)
    names: dict[Verdict, list[str]] = {verdict: [] for verdict in Verdict}
    for each in gates:
        if each.verdict is Verdict.FAILED and counts_of[each.name] > 1:
            names[each.verdict].append(f"{each.name} ({each.where})")
        elif (each.failed or each.name not in failing) and each.name not in names[each.verdict]:
            names[each.verdict].append(each.name)
    return f"{use}: " + "; ".join(f"{verdict}: {', '.join(which)}" for verdict, which in names.items() if which)
