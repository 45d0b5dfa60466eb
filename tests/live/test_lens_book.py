"""LensBook: what of a lens is known from elsewhere, and what it can do."""

import math

import pytest

from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from viewfinder.app.lenses import LensBook
from viewfinder.frames import LensState

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
    with pytest.raises(InputError, match="one of the lenses fifty, eighty"):
        book.choose("ninety")


def test_offered_f_numbers_are_the_lens_and_smaller_openings() -> None:
    assert LensBook(BOOK).f_numbers == [1.8, 2.0, 2.4, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0]


def test_states_complete_one_another() -> None:
    hand, camera = LensState(focus_distance_m=1.0), LensState(2.0, 2.8)
    assert hand.completed_by(camera) == LensState(1.0, 2.8)
