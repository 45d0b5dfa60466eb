"""Whether a budget in minutes has time for a network to learn anything, told by its first steps."""

import math
from collections.abc import Sequence

from training.settings import TrainSettings

LEAST_STEPS = 200
"""The smallest networks have learnt a lens roughly after so many; with a tenth of them the result is what it began as."""
_TELLING_STEPS = 6
_LONGEST_SHARE = 0.05  # of the budget until the rate is known; at LEAST_STEPS in all that would be ten steps


def is_rate_known(ends_s: Sequence[float], budget_s: float) -> bool:
    """Whether the steps so far tell the rate. ends_s: since training began; the first step also reads data and is not told by."""
    if not ends_s:
        return False
    if len(ends_s) == 1:
        return ends_s[0] > max(2.0 * _LONGEST_SHARE * budget_s, 10.0)
    used_s = ends_s[-1] - ends_s[0]
    return used_s > _LONGEST_SHARE * budget_s or (len(ends_s) >= _TELLING_STEPS and used_s > 0.01 * budget_s)


def seconds_of_a_step(ends_s: Sequence[float]) -> float:
    return ends_s[0] if len(ends_s) == 1 else (ends_s[-1] - ends_s[0]) / (len(ends_s) - 1)


def steps_within(ends_s: Sequence[float], budget_s: float) -> int:
    """How many steps the whole budget makes at that rate."""
    return len(ends_s) + max(0, int((budget_s - ends_s[-1]) / max(seconds_of_a_step(ends_s), 1e-9)))


def too_few_words(ends_s: Sequence[float], settings: TrainSettings, halo_px: int, least: int) -> str:
    """What to say to somebody whose budget has time for fewer steps than `least`. halo_px: see `training.crops.Drawing`."""
    minutes, step_s = settings.minutes or 0.0, seconds_of_a_step(ends_s)
    steps, enough = steps_within(ends_s, 60.0 * minutes), 1.25 * (ends_s[0] + least * step_s) / 60.0
    enough = math.ceil(enough) if enough > 5.0 else math.ceil(10.0 * enough) / 10.0
    took, plural = f"{float(format(step_s, '.2g')):g}", "" if steps == 1 else "s"
    return (
        f"{minutes:g} minutes make about {steps} step{plural} of {took} s, and a network learns no lens in fewer than {least}: "
        f"give --minutes {enough:g}, or make steps shorter with {' or '.join(_shorter_steps(settings, halo_px))}"
    )


def _shorter_steps(settings: TrainSettings, halo_px: int) -> list[str]:
    """What makes a step shorter, the most effective first."""
    ways = []
    if settings.network.form == "published":
        ways.append("--preset demo")
    elif not settings.crop_px:
        ways.append(f"--set crop_px={max(128, 4 * halo_px)}")
    elif settings.crop_px >= 8 * halo_px and settings.crop_px >= 64:
        ways.append(f"--set crop_px={settings.crop_px // 2}")
    if settings.batch > 1:
        ways.append("--set batch=1")
    return [*ways, "smaller pictures (`mrbokeh capture process --max-width`), whose blur has fewer pixels"]
