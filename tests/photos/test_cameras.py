"""`mrbokeh capture cameras`: a table of what is connected, or what to do where nothing is or the library is missing."""

import sys
from pathlib import Path

import pytest

import capture.tether.gphoto2_camera as cameras_module
from capture.commands.cameras import cameras_command
from capture.tether.gphoto2_config import explained
from mrbokeh.system.errors import MissingExtraError
from mrbokeh.system.gphoto2_library import library
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.tether.test_gphoto2 import card, in_own_interpreter

__all__ = ["card"]


def test_the_table(card: Path) -> None:
    """The virtual camera releases, but has neither motor, live view nor RAW."""
    done = in_own_interpreter("from capture.commands.cameras import cameras_command; cameras_command()", VCAMERADIR=str(card))
    assert done.returncode == 0, done.stderr
    row = next(line for line in done.stdout.splitlines() if "Nikon DSC D750" in line)
    assert [cell.strip() for cell in row.strip("│").split("│")][:6] == ["Nikon DSC D750", "usb:001,001", "yes", "-", "-", "-"]


def test_none_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras_module, "detected", list)
    told = printed_by(cameras_command, exit_code=1)
    assert "no camera found" in told and "udev" in told and "PTP" in told


def test_several_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras_module, "detected", lambda: [("A", "usb:001,001"), ("B", "usb:001,002")])
    refused(r"several cameras .*A at usb:001,001, B at usb:001,002.* --source gphoto2:PORT", cameras_module.open_camera)


def test_a_camera_that_another_program_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is in the table, with the reason in place of its abilities."""

    def held(*_: object, **__: object) -> None:
        gp = library()
        with explained("opening A at usb:001,001"):
            raise gp.GPhoto2Error(gp.GP_ERROR_IO_USB_CLAIM)

    monkeypatch.setattr(cameras_module, "detected", lambda: [("A", "usb:001,001")])
    monkeypatch.setattr(cameras_module, "open_camera", held)
    found = cameras_module.list_cameras()
    assert found[0].description is None and "gvfs" in found[0].problem and "-53" in found[0].problem
    assert "another program holds the camera" in " ".join(printed_by(cameras_command).split())


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[tether\]"):
        printed_by(cameras_command)
    monkeypatch.setattr(sys, "platform", "win32")
    refused(r"does not run on Windows.*folder:DIR", library)
