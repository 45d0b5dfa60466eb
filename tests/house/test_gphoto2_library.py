"""Which camera is meant, errors in words, and that nothing is imported before a camera is asked for."""

import subprocess
import sys

import pytest

from mrbokeh.system.errors import InputError
from mrbokeh.system.gphoto2_library import NoCameraError, chosen_of, explanation, library

TWO = [("A", "usb:001,001"), ("B", "usb:001,002")]


class GPhoto2Error(Exception):
    """As gphoto2 has it."""

    def __init__(self, code: int, string: str = "") -> None:
        super().__init__(f"[{code}] {string}")
        self.code, self.string = code, string


def test_the_only_camera_or_the_one_that_is_named() -> None:
    assert chosen_of(TWO[:1], None, "--camera") == TWO[0]
    assert chosen_of(TWO, "usb:001,002", "--camera") == TWO[1]


@pytest.mark.parametrize(
    ("found", "port", "sentence"),
    [
        ([], None, "no camera found.*udev"),
        ([], "usb:001,001", "no camera found.*udev"),
        (TWO, "usb:009,009", "no camera at usb:009,009, only at A at usb:001,001, B at usb:001,002"),
    ],
)
def test_a_camera_that_is_not_there(found: list[tuple[str, str]], port: str | None, sentence: str) -> None:
    with pytest.raises(NoCameraError, match=sentence):
        chosen_of(found, port, "--source")


def test_of_several_one_must_be_named() -> None:
    with pytest.raises(InputError, match=r"several cameras .*choose one with --source gphoto2:PORT") as refused:
        chosen_of(TWO, None, "--source")
    assert not isinstance(refused.value, NoCameraError), "waiting for it would not help"


def test_codes_are_explained_where_they_are_known() -> None:
    assert explanation(GPhoto2Error(-53, "Could not claim")).startswith("Could not claim (-53); another program holds the camera")
    assert explanation(GPhoto2Error(-1, "Unspecified")) == "Unspecified (-1)"
    assert explanation(GPhoto2Error(-110)) == "[-110]  (-110); the camera is busy: wait for its light to go out"


def test_the_codes_are_those_of_the_library() -> None:
    gp = pytest.importorskip("gphoto2", reason="the extra 'tether' is not installed")
    assert library() is gp
    expected = {
        gp.GP_ERROR_IO_USB_CLAIM: "another program",
        gp.GP_ERROR_IO_LOCK: "another program",
        gp.GP_ERROR_IO_USB_FIND: "not there any more",
        gp.GP_ERROR_IO: "connection broke",
        gp.GP_ERROR_IO_READ: "connection broke",
        gp.GP_ERROR_IO_WRITE: "connection broke",
        gp.GP_ERROR_TIMEOUT: "in time",
        gp.GP_ERROR_CAMERA_BUSY: "busy",
    }
    for code, words in expected.items():
        assert words in explanation(gp.GPhoto2Error(code))


def test_it_is_imported_late() -> None:
    """In an interpreter of its own, for this one may have it already."""
    script = "import sys, mrbokeh.system.gphoto2_library; sys.exit('gphoto2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
