"""Cameras over libgphoto2: its own virtual camera for what that has, and stand-ins that speak like Nikon's and Canon's motors.

The virtual camera is asked for when the library is loaded (VCAMERADIR), hence in an interpreter of its own. It has settings,
releases (handing out copies of a JPEG) and lists files, but no focus motor, live view, ISO or RAW setting.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from capture.tether.camera_driver import Ability, CameraError, CameraSettings, EndStop, Stop
from capture.tether.focus_motor import FocusAxis
from capture.tether.gphoto2_camera import CANON_STEPS_HOME, Gphoto2Camera
from capture.tether.gphoto2_config import CameraConfig, is_fixed_white_balance, is_manual, is_off, is_raw_only, number_in
from capture.tether.simulated_camera import SimulatedMotor
from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

gp = pytest.importorskip("gphoto2", reason="the extra 'tether' is not installed")

SCRIPT = """
import json, sys, warnings
warnings.simplefilter("error")
from capture.tether.camera_driver import CameraSettings
from capture.tether.gphoto2_camera import list_cameras, open_camera
from mrbokeh.system.errors import InputError

def sentence(what):
    try:
        what()
    except InputError as error:
        return f"{type(error).__name__}: {error}"

listed = [(each.model, each.port, sorted(each.description.abilities), each.problem) for each in list_cameras()]
camera = open_camera(listed[0][1])
settings = camera.configure(CameraSettings(exposure_time_s=1 / 50, f_number=4.1))
shots = [camera.capture() for _ in range(2)]
dng = camera.download("/store_00010001", "raw.dng")
print(json.dumps({
    "listed": listed, "settings": settings, "again": camera.configure(CameraSettings()),
    "shots": [(each.name, each.data.hex(), each.steps) for each in shots], "dng": dng.hex(),
    "preview": sentence(camera.preview), "focus": sentence(lambda: camera.focus_step(5)),
    "iso": sentence(lambda: camera.configure(CameraSettings(iso=200.0))),
    "wide": sentence(lambda: camera.configure(CameraSettings(f_number=1.4))),
    "missing": sentence(lambda: camera.download("/store_00010001", "no.jpg")), "port": sentence(lambda: open_camera("usb:009,009")),
}))
camera.close()
"""


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the virtual camera has in it: a JPEG to hand out, and a RAW."""
    folder = tmp_path_factory.mktemp("card")
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    (folder / "GPH_0001.JPG").write_bytes(cv2.imencode(".jpg", pixels)[1].tobytes())
    sensor = SensorModel()
    write_dng(folder / "raw.dng", np.full((32, 48), 3000, np.uint16), sensor, ShotMetadata(Lens(35.0, 2.0, 1.0, 23.5)))
    return folder


def in_own_interpreter(script: str, **environment: str) -> subprocess.CompletedProcess[str]:
    root = str(Path(__file__).resolve().parents[2])
    search = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": search, "COLUMNS": "160", "NO_COLOR": "1"} | environment
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, timeout=120)


@pytest.fixture(scope="module")
def answers(card: Path) -> dict[str, Any]:
    done = in_own_interpreter(SCRIPT, VCAMERADIR=str(card))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_virtual_camera_is_listed_with_what_it_can(answers: dict[str, Any]) -> None:
    assert answers["listed"] == [["Nikon DSC D750", "usb:001,001", ["shutter"], ""]]


def test_the_virtual_camera_is_configured(answers: dict[str, Any]) -> None:
    """Of what it has: 1/50 s is its "0.0200s"; f/4 is the nearest to 4.1; what was set stays."""
    expected = {"autofocus": "Off", "capture target": "Internal RAM", "exposure time": "0.0200s", "f-number": "f/4"}
    assert answers["settings"] == answers["again"] == expected and "cannot be set over the cable" in answers["iso"]
    assert answers["wide"].startswith("InputError: the camera has no f-number of 1.4: it offers f/2.8,")


def test_the_virtual_camera_captures_and_hands_over(answers: dict[str, Any], card: Path) -> None:
    assert [bytes.fromhex(data) for _, data, _ in answers["shots"]] == [(card / "GPH_0001.JPG").read_bytes()] * 2
    names = [name for name, _, _ in answers["shots"]]
    assert names[0] != names[1] and all(name.startswith("GPH_") and name.endswith(".JPG") for name in names)
    assert [steps for _, _, steps in answers["shots"]] == [None, None]
    assert bytes.fromhex(answers["dng"]) == (card / "raw.dng").read_bytes()


def test_what_the_virtual_camera_has_not_is_said(answers: dict[str, Any]) -> None:
    assert answers["preview"].startswith("CameraError: the live view failed") and "--by-hand" in answers["focus"]
    assert answers["missing"].startswith("CameraError: copying no.jpg failed")
    assert answers["port"] == "CameraError: no camera at usb:009,009, only at Nikon DSC D750 at usb:001,001"


@dataclass
class Widget:
    """A setting as libgphoto2 gives it: a copy, written back by set_single_config."""

    value: Any
    words: Sequence[str] = ()
    readonly: bool = False

    def get_value(self) -> Any:
        return self.value

    def set_value(self, value: Any) -> None:
        self.value = value

    def get_type(self) -> int:
        return gp.GP_WIDGET_RADIO if self.words else gp.GP_WIDGET_RANGE

    def count_choices(self) -> int:
        return len(self.words)

    def get_choice(self, index: int) -> str:
        return self.words[index]

    def get_readonly(self) -> bool:
        return self.readonly


@dataclass
class StandIn:
    """Settings in memory. Files: what a release adds, in the order of the events."""

    widgets: dict[str, Widget]
    files: Sequence[str] = ("DSC_0001.NEF",)
    busy: int = 0
    set_log: list[tuple[str, Any]] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    exited: bool = False

    def get_single_config(self, name: str) -> Widget:
        if name not in self.widgets:
            raise gp.GPhoto2Error(gp.GP_ERROR_BAD_PARAMETERS)
        kept = self.widgets[name]
        return Widget(kept.value, kept.words, kept.readonly)

    def set_single_config(self, name: str, widget: Widget) -> None:
        if self.busy:
            self.busy -= 1
            raise gp.GPhoto2Error(gp.GP_ERROR_CAMERA_BUSY)
        self.set_log.append((name, widget.value))
        self.widgets[name].value = widget.value

    def get_abilities(self) -> SimpleNamespace:
        return SimpleNamespace(model="Stand-in", operations=gp.GP_OPERATION_CAPTURE_IMAGE | gp.GP_OPERATION_CAPTURE_PREVIEW)

    def capture_preview(self) -> SimpleNamespace:
        blue = np.full((16, 24, 3), (250, 10, 10), np.uint8)
        return SimpleNamespace(get_data_and_size=lambda: cv2.imencode(".jpg", blue)[1].tobytes())

    def capture(self, _: int) -> SimpleNamespace:
        assert self.widgets["viewfinder"].value == 0, "live view is off while a photograph is taken and copied"
        self.events = list(self.files[1:])
        return SimpleNamespace(folder="/", name=self.files[0])

    def wait_for_event(self, _: int) -> tuple[int, Any]:
        if not self.events:
            return gp.GP_EVENT_TIMEOUT, None
        return gp.GP_EVENT_FILE_ADDED, SimpleNamespace(folder="/", name=self.events.pop(0))

    def file_get(self, _: str, name: str, __: int) -> SimpleNamespace:
        return SimpleNamespace(get_data_and_size=lambda: name.encode())

    def exit(self) -> None:
        self.exited = True


@dataclass
class StandInNikon(StandIn):
    """manualfocusdrive as libgphoto2 has it for Nikon: only in live view, -113 at the end of the travel."""

    motor: SimulatedMotor = field(default_factory=lambda: SimulatedMotor(2.0, travel_steps=40000, backlash_steps=40))

    def set_single_config(self, name: str, widget: Widget) -> None:
        super().set_single_config(name, widget)
        if name == "manualfocusdrive":
            if not self.widgets["viewfinder"].value:
                raise gp.GPhoto2Error(gp.GP_ERROR)
            assert abs(widget.value) <= 32767
            try:
                self.motor.drive(int(widget.value))
            except EndStop:
                raise gp.GPhoto2Error(gp.GP_ERROR_CAMERA_ERROR) from None


@dataclass
class StandInCanon(StandIn):
    """Near and Far 1 to 3; a word that is set already does nothing; the end of the travel is not reported."""

    motor: SimulatedMotor = field(default_factory=lambda: SimulatedMotor(2.0, travel_steps=3000, backlash_steps=0))

    def set_single_config(self, name: str, widget: Widget) -> None:
        before = self.widgets[name].value
        super().set_single_config(name, widget)
        if name == "manualfocusdrive" and widget.value not in ("None", before):
            way, level = widget.value.split()
            with suppress(EndStop):
                self.motor.drive((1 if way == "Far" else -1) * {"1": 5, "2": 30, "3": 150}[level])


def nikon(**widgets: Widget) -> StandInNikon:
    return StandInNikon({"viewfinder": Widget(0), "manualfocusdrive": Widget(0.0)} | widgets)


def canon(**widgets: Widget) -> StandInCanon:
    words = ("Near 1", "Near 2", "Near 3", "None", "Far 1", "Far 2", "Far 3")
    return StandInCanon({"viewfinder": Widget(0), "manualfocusdrive": Widget("None", words)} | widgets)


def driver_of(stand_in: StandIn, **options: Any) -> Gphoto2Camera:
    return Gphoto2Camera(stand_in, "memory", sleep=lambda _: None, **options)


@pytest.mark.parametrize("stop", list(Stop))
def test_a_nikon_homes_at_the_end_error_and_counts_from_there(stop: Stop) -> None:
    """A travel longer than one command may go (32767): two of them home, and a long way is split."""
    stand_in = nikon()
    camera = driver_of(stand_in)
    camera.home(stop)
    assert stand_in.motor.lens == (0 if stop is Stop.near else 40000)
    axis = FocusAxis(camera, stop, backlash_steps=100, sleep=lambda _: None)
    axis.move_to(35040)
    assert stand_in.motor.lens == (35000 if stop is Stop.near else 5000)
    axis.move_to(1040)
    assert stand_in.motor.lens == (1000 if stop is Stop.near else 39000) and camera.capture().steps == 1040 * stop.away
    with pytest.raises(EndStop):
        camera.focus_step(stop.away * 50000)
    # One that runs the other way.
    driver_of(stand_in, reverse_focus=True).home(stop)
    assert stand_in.motor.lens == (40000 if stop is Stop.near else 0)


def test_a_canon_needs_none_between_steps() -> None:
    """Steps of 5 of the motor's; homing by large ones, since no end is reported."""
    stand_in = canon()
    camera = driver_of(stand_in)
    camera.home(Stop.near)
    assert stand_in.motor.lens == 0 and stand_in.set_log.count(("manualfocusdrive", "Near 3")) == CANON_STEPS_HOME
    camera.focus_step(40)
    assert stand_in.motor.lens == 200
    camera.focus_step(-10)
    assert stand_in.motor.lens == 150 and camera.capture().steps == 30
    coarse = driver_of(stand_in, focus_level=2)
    coarse.focus_step(3)
    assert stand_in.motor.lens == 240


def test_a_busy_camera_is_asked_again_and_a_motor_that_stays_busy_named() -> None:
    stand_in = nikon(viewfinder=Widget(1))
    camera = driver_of(stand_in)
    camera.preview()
    stand_in.busy = 5
    camera.focus_step(100)
    stand_in.busy = 1000
    with pytest.raises(CameraError, match="stays busy"):
        camera.focus_step(10)


def test_live_view_its_end_and_the_raw_of_two_files() -> None:
    stand_in = nikon()
    camera = driver_of(stand_in)
    frame = camera.preview()
    stand_in.files = ("DSC_0001.JPG", "DSC_0001.NEF")
    shot = camera.capture()
    assert (shot.name, shot.data) == ("DSC_0001.NEF", b"DSC_0001.NEF"), "the RAW of two files"
    camera.preview()
    assert frame.shape == (16, 24, 3) and frame[8, 12, 2] > 200 > frame[8, 12, 0], "RGB, not OpenCV's order"
    assert stand_in.widgets["viewfinder"].value == 1
    camera.close()
    assert stand_in.widgets["viewfinder"].value == 0 and stand_in.exited


def test_what_a_stand_in_can() -> None:
    words = ("JPEG Fine", "NEF (Raw)", "NEF+Fine")
    abilities = driver_of(nikon(imagequality=Widget("JPEG Fine", words))).describe().abilities
    assert abilities == set(Ability) and driver_of(StandIn({})).describe().abilities == {Ability.shutter}


def test_a_full_configuration() -> None:
    stand_in = nikon(
        expprogram=Widget("A", ("P", "A", "S", "M")), imagequality=Widget("NEF+Fine", ("JPEG Fine", "NEF+Fine", "NEF (Raw)")),
        whitebalance=Widget("Automatic", ("Automatic", "Daylight", "Shade")), isoauto=Widget("On", ("On", "Off")),
        iso=Widget("400", ("100", "200", "400")), shutterspeed=Widget("1/125", ("1/125", "1/60", "1/30")),
        autofocus=Widget("On", ("On", "Off")), focusmode=Widget("AF-S", ("AF-S", "Manual")),
    )  # fmt: skip
    settings = driver_of(stand_in).configure(CameraSettings(exposure_time_s=1 / 60, iso=100.0, white_balance="shade"))
    assert settings == {
        "exposure mode": "M", "automatic ISO": "Off", "autofocus": "Off", "focus mode": "AF-S", "file format": "NEF (Raw)",
        "white balance": "Shade", "exposure time": "1/60", "ISO": "100",
    }  # fmt: skip
    assert stand_in.widgets["focusmode"].value == "AF-S", "a motor can only be driven in autofocus"
    without_motor = StandIn({"focusmode": Widget("AF-S", ("AF-S", "MF"))})
    assert driver_of(without_motor).configure(CameraSettings()) == {"focus mode": "MF"}


@pytest.mark.parametrize(
    ("name", "widget", "said"),
    [
        ("expprogram", Widget("A", ("P", "A", "M"), readonly=True), r"manual exposure \(M\) must be set on the camera"),
        ("autoexposuremode", Widget("AV", ("AV",)), "manual exposure"), ("iso", Widget("Auto", ("Auto", "100")), r"ISO is automatic"),
        ("shutterspeed", Widget("auto", ("auto", "1/60")), "exposure time in seconds is automatic"),
        ("imageformat", Widget("L", ("L", "RAW + L"), readonly=True), "RAW must be set"),
        ("whitebalance", Widget("Auto", ("Auto", "AWB White")), "a fixed white balance must be set"),
    ],
)  # fmt: skip
def test_automatic_is_refused(name: str, widget: Widget, said: str) -> None:
    with pytest.raises(InputError, match=said):
        driver_of(nikon(**{name: widget})).configure(CameraSettings())


def test_the_nearest_choice() -> None:
    """Exposure times of cameras are rounded: 1/60 is 0.0166s to a Nikon. 1/60 is not 1/50 (20 % off)."""
    stand_in = StandIn({"shutterspeed": Widget("0.0200s", ("0.0200s", "0.0166s", "bulb"))})
    assert driver_of(stand_in).configure(CameraSettings(exposure_time_s=1 / 60)) == {"exposure time": "0.0166s"}
    with pytest.raises(InputError, match=r"no exposure time in seconds of 0\.1: it offers 0\.0200s, 0\.0166s"):
        driver_of(stand_in).configure(CameraSettings(exposure_time_s=0.1))
    assert CameraConfig(stand_in).choices("nothing") == []


def test_words_of_cameras() -> None:
    numbers = {"f/4": 4, "0.0166s": 0.0166, "1/125": 0.008, "ISO 200": 200, "30": 30, "Bulb": None, "1/0": None}
    assert {words: number_in(words) for words in numbers} == numbers
    raw, others = ("NEF (Raw)", "RAW", "cRAW"), ("RAW+JPEG", "NEF+Basic", "RAW + Large Fine JPEG", "Large Fine JPEG")
    assert all(is_raw_only(each) for each in raw) and not any(is_raw_only(each) for each in others)
    assert is_manual("M") and is_manual("Manual") and not is_manual("AV")
    assert is_off("Off") and is_off("MF") and not is_off("AF-S") and not is_off("On")
    assert not any(is_fixed_white_balance(each) for each in ("Auto", "Automatic", "AWB", ""))
