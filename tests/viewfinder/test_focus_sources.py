"""Focus: who knows it, by hand, with the frame, several in order; LensBook: what a lens can do with what is known of it."""

import math

import numpy as np
import pytest

from mrbokeh.optics.lens import Lens
from tests.support.refusals import refused
from viewfinder.app.opening import LensBook
from viewfinder.focus.sources import FirstKnown, FrameFocus, ManualFocus, open_focus
from viewfinder.frames import CameraFrame, LensState
from viewfinder.tracking.tracker import TrackedPose

POSE = TrackedPose(np.eye(4), 1.0, 0.0)


def frame(captured_s: float = 0.0, lens: LensState | None = None) -> CameraFrame:
    return CameraFrame(np.zeros((4, 6, 3), np.uint8), captured_s, 0, lens or LensState())


class Counted:
    """A source that knows one thing and counts how often it is asked and closed."""

    def __init__(self, name: str, lens: LensState) -> None:
        self.name, self.lens, self.asked, self.closed = name, lens, 0, 0

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:  # noqa: ARG002
        self.asked += 1
        return self.lens

    def close(self) -> None:
        self.closed += 1


def test_by_hand() -> None:
    manual = ManualFocus()
    assert manual.state(frame(), POSE) == LensState()
    manual.focus(2.5)
    manual.set_f_number(2.0)
    assert manual.state(frame(), None) == LensState(2.5, 2.0)
    manual.focus(math.inf)
    assert manual.state(frame(), None).focus_distance_m == math.inf
    manual.focus(None)
    assert manual.state(frame(), None) == LensState(None, 2.0)


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.nan])
def test_wrong_by_hand_changes_nothing(wrong: float) -> None:
    manual = ManualFocus(LensState(1.0, 4.0))
    for call in (manual.focus, manual.set_f_number):
        refused("expected", call, wrong)
    assert manual.state(frame(), None) == LensState(1.0, 4.0)


def test_what_a_frame_tells_holds_for_a_while() -> None:
    source = FrameFocus(hold_s=1.0)
    assert source.state(frame(0.0), None) == LensState()
    assert source.state(frame(0.1, LensState(2.0, 4.0)), None) == LensState(2.0, 4.0)
    assert source.state(frame(0.9, LensState(focus_distance_m=3.0)), None) == LensState(3.0, 4.0)
    assert source.state(frame(1.8), None) == LensState(3.0, 4.0) and source.state(frame(2.0), None) == LensState()


def test_first_known_of_each_value() -> None:
    first = Counted("first", LensState(f_number=2.0))
    second = Counted("second", LensState(3.0, 4.0))
    third = Counted("third", LensState(5.0, 5.0, 50.0))
    both = FirstKnown([first, second, third])
    assert both.state(frame(), POSE) == LensState(3.0, 2.0, 50.0)
    assert both.focus_from == "second" and both.name == "first, else second, else third"
    assert (first.asked, second.asked, third.asked) == (1, 1, 1)
    second.lens = third.lens = LensState()
    assert both.state(frame(), POSE) == LensState(None, 2.0) and both.focus_from is None
    both.close()
    assert (first.closed, second.closed, third.closed) == (1, 1, 1)


def test_who_is_asked_first_for_the_focus() -> None:
    """By hand 3 m, the frame says 2 m; the board's 0.9 m counts only where it is named."""
    told, board = frame(1.0, LensState(2.0, 4.0)), Counted("blur of the board", LensState(0.9))
    manual = ManualFocus(LensState(3.0))
    expected: dict[tuple[str, ...], tuple[float, str]] = {
        (): (3.0, manual.name),
        ("source",): (2.0, FrameFocus.name),
        ("source", "hand"): (2.0, FrameFocus.name),
        ("hand", "source"): (3.0, manual.name),
        ("board",): (0.9, board.name),
        ("hand", "board"): (3.0, manual.name),
    }
    for first, (metres, name) in expected.items():
        focus = open_focus(manual, None, first, board if "board" in first else None)
        assert (focus.state(told, None), focus.focus_from) == (LensState(metres, 4.0), name), first
    manual.focus(None)
    focus = open_focus(manual, None, ("hand", "board"), board)
    assert focus.state(told, None).focus_distance_m == 0.9, "what nobody set by hand comes from the next"


FIFTY = Lens(50.0, 1.8, 2.0, 36.0)
BOOK = {"fifty": FIFTY, "eighty": Lens(85.0, 1.4, 3.0, 36.0)}


def test_the_lens_is_as_its_file_has_it_until_somebody_knows_better() -> None:
    book = LensBook(BOOK)
    assert book.as_set(LensState()) == FIFTY
    set_now = book.as_set(LensState(focus_distance_m=math.inf, f_number=4.0))
    assert (set_now.focus_distance_m, set_now.f_number, set_now.focal_length_mm) == (math.inf, 4.0, 50.0)
    assert book.as_set(LensState(focal_length_mm=70.0)).focal_length_mm == 70.0, "a zoom tells"
    assert book.as_set(LensState(focus_distance_m=0.01)).focus_distance_m == 0.075, "one and a half focal lengths"


def test_choosing() -> None:
    book = LensBook(BOOK)
    book.choose("eighty")
    assert (book.chosen, book.lens.focal_length_mm, book.names) == ("eighty", 85.0, ["fifty", "eighty"])
    assert book.slider_dioptres == (0.0, pytest.approx(1 / 0.51))
    refused("one of the lenses fifty, eighty", book.choose, "ninety")


def test_offered_f_numbers_are_the_lens_and_smaller_openings() -> None:
    assert LensBook(BOOK).f_numbers == [1.8, 2.0, 2.4, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0]


def test_states_complete_one_another() -> None:
    hand, camera = LensState(focus_distance_m=1.0), LensState(2.0, 2.8)
    assert hand.completed_by(camera) == LensState(1.0, 2.8)
