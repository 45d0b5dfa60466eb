"""A watched folder as a camera: files that are still growing, pairs of RAW and JPEG, what lay there before; time is simulated."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.tether.camera_driver import CameraError, CameraSettings, Stop
from capture.tether.focus_plan import FocusRange, plan_focus
from capture.tether.shoot import ShootOptions, Surroundings, shoot
from capture.tether.watched_folder import WatchedFolder, is_whole
from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from mrbokeh.optics.lens import Lens
from tests.support.refusals import refused

LENS = Lens(35.0, 2.0, 1.0, 23.5)


@dataclass
class SimulatedTime:
    """A clock that only sleeping moves; events happen when their time has come."""

    now_s: float = 0.0
    events: list[tuple[float, Callable[[], object]]] = field(default_factory=list)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        for event in [each for each in self.events if each[0] <= self.now_s]:
            self.events.remove(event)
            event[1]()

    def clock(self) -> float:
        return self.now_s


def jpeg(seed: int = 0) -> bytes:
    pixels = np.random.default_rng(seed).integers(0, 255, (48, 64, 3), np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def dng(folder: Path) -> bytes:
    """Made outside of the watched folder."""
    sensor, path = SensorModel(), folder.parent / "made.dng"
    write_dng(path, np.full((32, 48), 3000, np.uint16), sensor, ShotMetadata(LENS))
    return path.read_bytes()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "incoming").mkdir()
    return tmp_path / "incoming"


def watched(folder: Path, time: SimulatedTime, timeout_s: float = 100.0) -> WatchedFolder:
    return WatchedFolder(folder, timeout_s=timeout_s, sleep=time.sleep, clock=time.clock)


def append(path: Path, data: bytes) -> None:
    with path.open("ab") as file:
        file.write(data)


@pytest.mark.parametrize("kind", ["jpg", "dng"])
def test_a_slow_writer(folder: Path, kind: str) -> None:
    """Quarters of a file with pauses longer than the time a file has to rest: only the whole file is taken, byte for byte."""
    data = jpeg() if kind == "jpg" else dng(folder)
    path, quarter = folder / f"IMG_1.{kind}", len(data) // 4 + 1
    parts = [data[start : start + quarter] for start in range(0, len(data), quarter)]
    time = SimulatedTime(events=[(10.0 + 8.0 * index, lambda part=part: append(path, part)) for index, part in enumerate(parts)])
    shot = watched(folder, time).capture()
    assert shot.data == data and shot.name == path.name and shot.steps is None and time.now_s > 10.0 + 8.0 * 3
    assert path.read_bytes() == data, "the photographer's file stays"


def test_a_file_that_grows_after_its_end_mark_is_not_taken_yet(folder: Path) -> None:
    """A JPEG with another behind it (as phones write): whole by its end, but it has not rested for a second."""
    path, first = folder / "IMG_1.jpg", jpeg()
    time = SimulatedTime(events=[(0.2 * index, lambda: append(path, first)) for index in range(1, 30)])
    assert watched(folder, time).capture().data == first * 29


def test_raw_goes_before_its_jpeg_and_both_are_one_shot(folder: Path) -> None:
    """The JPEG comes first, as cards send it; the RAW two seconds later. The next shot is another name."""
    raw, time = dng(folder), SimulatedTime()
    time.events = [
        (1.0, lambda: append(folder / "IMG_1.JPG", jpeg(1))), (3.0, lambda: append(folder / "IMG_1.DNG", raw)),
        (20.0, lambda: append(folder / "IMG_2.JPG", jpeg(2))), (21.0, lambda: append(folder / "notes.txt", b"no photograph")),
        (21.0, lambda: append(folder / ".IMG_3.JPG", jpeg(3))),
    ]  # fmt: skip
    camera = watched(folder, time)
    assert (camera.capture().name, camera.capture().data) == ("IMG_1.DNG", jpeg(2))
    with pytest.raises(CameraError, match=r"no whole photograph .* within 100 s \(unfinished: nothing\)"):
        camera.capture()


def test_what_lay_there_before_is_not_taken_and_half_a_file_is_named(folder: Path) -> None:
    (folder / "IMG_0.jpg").write_bytes(jpeg())
    time = SimulatedTime(events=[(5.0, lambda: append(folder / "IMG_1.jpg", jpeg()[:200]))])
    with pytest.raises(CameraError, match=r"unfinished: IMG_1\.jpg"):
        watched(folder, time).capture()


def test_what_a_folder_cannot(folder: Path) -> None:
    camera = watched(folder, SimulatedTime())
    assert camera.describe().abilities == frozenset() and camera.configure(CameraSettings()) == {}
    refused("cannot set exposure_time_s, iso", camera.configure, CameraSettings(exposure_time_s=0.1, iso=100.0))
    for ask in (camera.preview, lambda: camera.focus_step(1), lambda: camera.home(Stop.near)):
        with pytest.raises(CameraError, match="a watched folder has no"):
            ask()
    refused("there is none", WatchedFolder, folder / "missing")


def test_a_bracket_through_a_folder(folder: Path, tmp_path: Path) -> None:
    """The photographer focuses as told and releases; files are taken over as slices, in the order in which they come."""
    plan = plan_focus(LENS, FocusRange(0.5, 2.0), 96, 3.0)
    time, said = SimulatedTime(), []

    def told(text: str) -> None:
        said.append(text)
        time.events.append((time.now_s + 6.0, lambda: append(folder / f"P{900 - len(said)}.jpg", jpeg(len(said)))))

    world = Surroundings(told, told, time.sleep)
    log = shoot(plan, watched(folder, time), tmp_path / "view", ShootOptions(check=False), world)
    assert [log.slices[index]["camera_name"] for index in sorted(log.slices)] == [f"P{899 - index}.jpg" for index in range(len(plan))]
    assert (tmp_path / "view" / "slice_00.jpg").read_bytes() == jpeg(1)
    assert "slice 0 of 0 to 1: focus at 0.538 m" in said[0]
    assert "sensor_width_mm = 23.5" in (tmp_path / "view" / "lens.toml").read_text(), "a JPEG without EXIF states nothing"


def test_whole_or_not(tmp_path: Path) -> None:
    for name, data in (
        ("a.jpg", jpeg()),
        ("a.png", cv2.imencode(".png", np.zeros((9, 9, 3), np.uint8))[1].tobytes()),
        ("a.dng", dng(tmp_path / "x")),
    ):
        path = tmp_path / name
        path.write_bytes(data)
        assert is_whole(path)
        path.write_bytes(data[: len(data) - 20])
        assert not is_whole(path)
        path.write_bytes(b"")
        assert not is_whole(path)
    assert not is_whole(tmp_path / "gone.jpg")
