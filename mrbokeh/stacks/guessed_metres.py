"""Knowledge of the metres of a focal stack, in one line for people.

Where no focus distance is known, merging measures blur from the slices alone and guesses the metres (`metadata["metres"]`: known, why,
guessed, told, gauge): circles of confusion are right in pixels, lengths and distances are not, until one known length or distance is told.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FILE_NAME, METRES, FocalStack, read_focal_stack
from mrbokeh.system.messages import guess

GUESSED = "guessed metres"
STATED_BEFORE = "stated_before_guessing"
"""Key in a stack's metadata: the lens and camera that it stated, or None."""
STATED_DISTANCE = "stated_focus_distance_m"
"""Key in a slice's metadata: the focus distance that was stated of it, or None, where another one has taken its place."""
SLICE_POSITION, SLICE_POSITION_ERROR = "blur_position_px", "blur_position_error_px"
"""Keys in a slice's metadata: where it is focused in pixels of blur, growing towards the camera, and the standard error."""
POSITION, POSITION_ERROR = "blur_position", "blur_position_error"
"""Channels of depth.exr: where the surface lies in pixels of blur, growing towards the camera, and its standard error."""
TOLD = "told"
"""Key in what is known of a stack's metres: the lengths and distances that the user told."""
_OF_ITS_DEPTH = ("known", "why", "guessed")


def stated_distances_m(stack: FocalStack) -> tuple[float | None, ...]:
    """Return the distances stated by the camera or the user, also after a calibration has replaced them."""
    stated = (each.metadata.get(STATED_DISTANCE, each.focus_distance_m) for each in stack.slices)
    return tuple(None if each is None else float(each) for each in stated)


def metres_facts(stack: FocalStack) -> Mapping[str, Any]:
    """Return what is known of a stack's metres; {} for stacks that state theirs.

    known: whether metres are; why: in words; guessed: what else is a guess if they are known.
    """
    facts = stack.metadata.get(METRES)
    return facts if isinstance(facts, Mapping) else {}


def inherited_facts(stack: FocalStack, with_lens: bool) -> dict[str, Any]:
    """Return the metadata on metres that a stack made of another's picture and depth takes over.

    with_lens: it is seen through that stack's own lens; what is known of the blur of this one says nothing of another.
    """
    if METRES not in stack.metadata:
        return {}
    if with_lens:
        return {name: stack.metadata[name] for name in (METRES, STATED_BEFORE) if name in stack.metadata}
    facts = metres_facts(stack)
    return {METRES: {name: facts[name] for name in _OF_ITS_DEPTH if name in facts}}


def is_lens_guessed(stack: FocalStack) -> bool:
    """Return whether focal length and f-number only stand for the blur that was measured."""
    gauge = metres_facts(stack).get("gauge")
    if not gauge:
        return False
    stated = gauge["scale_from"] == "lens" or bool((stack.metadata.get(STATED_BEFORE) or {}).get("lens"))
    return not stated


def is_view_guessed(stack: FocalStack) -> bool:
    """Return whether nobody knows the field of view."""
    return is_lens_guessed(stack) and not (stack.metadata.get(STATED_BEFORE) or {}).get("camera")


def unit_of(stack: FocalStack) -> str:
    """Return the unit of its distances, for messages."""
    return "m" if stack.metres_known else GUESSED


def metres_note(stack: FocalStack) -> str:
    """State what is known and what is guessed in one sentence; empty where all metres are known."""
    facts, end = metres_facts(stack), _guessed_end(stack)
    if not stack.metres_known:
        turn = f", and if near and far are swapped `--nearest {'last' if end == 'first' else 'first'}`" if end else ""
        way = f"give one known length by `mrbokeh capture scale {stack.folder} --ruler X1,Y1,X2,Y2,METRES`{turn}"
        if "gauge" not in facts:
            way = "give one known length to the stack that it was made from by `mrbokeh capture scale`, and make it again"
        return f"{stack.folder}: metres are guessed: {facts['why']}{f', the {end} slice nearest' if end else ''}; {way}"
    guessed = guesses(stack)
    return f"{stack.folder}: {facts['why']}; still guessed: {guessed}" if guessed else ""


def metres_line(stack: FocalStack) -> str:
    """Say in a few words what is guessed and where more is told; empty where all metres are known. `metres_note` gives the reasons."""
    if not metres_note(stack):
        return ""
    more = f"more in {stack.folder / FILE_NAME}"
    if stack.metres_known:
        return f"{stack.folder}: still guessed: {guesses(stack)} ({more})"
    end = _guessed_end(stack)
    nearest, turn = (f", the {end} slice nearest", ", --nearest turns them") if end else ("", "")
    return f"{stack.folder}: metres are guessed{nearest}; `mrbokeh capture scale --ruler` makes them known{turn} ({more})"


def guess_metres(stack: FocalStack) -> None:
    """Say which metres are guessed, in a few words; --json holds the reasons."""
    guess(metres_note(stack), metres_line(stack))


def growth_note(stack: FocalStack, lens: Lens | None) -> str:
    """State how fast another lens's blur grows, focused as the reference slice; empty for the stack's lens and where metres are known."""
    if lens is None or not metres_note(stack):
        return ""
    own = stack.registered_lens_of(stack.reference)
    times = lens.focused_at(own.focus_distance_m).coc_px_per_dioptre(1) / own.coc_px_per_dioptre(1)
    return f"the blur of this lens grows {times:.2f} times as fast as in the slices"


def guesses(stack: FocalStack) -> str:
    """Name what is guessed of a stack whose metres are known; empty where nothing is."""
    end, guessed = _guessed_end(stack), metres_facts(stack).get("guessed")
    return "; ".join([*([guessed] if guessed else []), *([f"that the {end} slice is the nearest (else tell --nearest)"] if end else [])])


def is_near_first(stack: FocalStack) -> bool:
    """Return whether its first slice is focused nearer than its last."""
    first, last = (stack.focus_distances_m[index] for index in (0, -1))
    return float(first or 0.0) < float(last or 0.0)


def _guessed_end(stack: FocalStack) -> str | None:
    """Return "first" or "last": the slice that is taken for the nearest, where that is a guess."""
    gauge = metres_facts(stack).get("gauge") or {}
    if gauge.get("near_first_sure", True):
        return None
    return "first" if is_near_first(stack) else "last"


def metres_notes(stacks: Iterable[FocalStack]) -> str:
    """Return one line for all stacks of a command; empty if all metres are known."""
    lines = [line for line in map(metres_line, stacks) if line]
    if len(lines) < 2:
        return "".join(lines)
    return f"metres are guessed, at least in part, in {len(lines)} of the stacks, in pixels blur is measured; the first: {lines[0]}"


def stack_of_file(path: Path | None) -> FocalStack | None:
    """Return the stack that a picture or depth file belongs to."""
    return None if path is None or not (path.parent / FILE_NAME).is_file() else read_focal_stack(path.parent)
