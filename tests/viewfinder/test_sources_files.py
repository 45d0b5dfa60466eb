"""Sources that are files and words: a folder that photographs come into, videos, sizes, and what --source understands."""

import os
import time
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from threading import Event

import cv2
import numpy as np
import pytest
from PIL import Image

from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from mrbokeh.system.errors import InputError, MissingExtraError
from mrbokeh.video.clip import probe
from mrbokeh.video.color import linear_from_code
from tests.support.refusals import refused
from tests.support.video_files import filmed
from viewfinder.frames import CameraFrame, LensState
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import FrameSource, SizeLimit
from viewfinder.sources.playback import NotWholeError, Rhythm, WatchedFolderSource, read_tethered

WIDTH, HEIGHT = 96, 64
RNG = np.random.default_rng(3)
NOISE = RNG.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def encoded(suffix: str, level: int) -> bytes:
    """Noise over a level: a picture whose bytes are spread over the file."""
    picture = np.clip(NOISE.astype(int) // 4 + level, 0, 255)
    return cv2.imencode(suffix, picture.astype(np.uint16) * 257 if suffix == ".tif" else picture.astype(np.uint8))[1].tobytes()


def level_of(frame: CameraFrame) -> float:
    return float(frame.bgr.mean()) - float(np.mean(NOISE // 4))


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[tuple[Path, WatchedFolderSource, Iterator[CameraFrame]]]:
    folder = tmp_path / "tethered"
    folder.mkdir()
    (folder / "0000.jpg").write_bytes(encoded(".jpg", 20))
    source, stopping = WatchedFolderSource(folder, fps=200.0), Event()
    frames = source.frames(stopping)
    yield folder, source, frames
    stopping.set()
    frames.close()  # type: ignore[attr-defined]


def comes(frames: Iterator[CameraFrame], right: Callable[[CameraFrame], object], limit_s: float = 20.0) -> CameraFrame:
    start_s = time.monotonic()
    for frame in frames:
        if right(frame):
            return frame
        assert time.monotonic() - start_s < limit_s
    raise AssertionError("the source ended")


def shows(level: int) -> Callable[[CameraFrame], bool]:
    return lambda frame: abs(level_of(frame) - level) < 3


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_a_half_written_photograph_is_not_shown(watched: tuple[Path, WatchedFolderSource, Iterator[CameraFrame]], suffix: str) -> None:
    folder, source, frames = watched
    comes(frames, shows(20))
    data = encoded(suffix, 120)
    with (folder / f"0001{suffix}").open("wb") as file:
        for part in (data[: len(data) // 2], data[len(data) // 2 : -30]):
            file.write(part)
            file.flush()
            for _ in range(4):
                assert shows(20)(next(frames))
        assert "waiting until it is whole" in str(source.status)
        file.write(data[-30:])
    assert comes(frames, shows(120)).bgr.shape == (HEIGHT, WIDTH, 3) and source.status is None


def test_the_newest_counts_by_when_it_came(watched: tuple[Path, WatchedFolderSource, Iterator[CameraFrame]]) -> None:
    """Not by its date, which copying from a card keeps; a file that is written over counts as new; others do not."""
    folder, source, frames = watched
    first, old = comes(frames, shows(20)), folder / "from_card.jpg"
    old.write_bytes(encoded(".jpg", 70))
    os.utime(old, (1e9, 1e9))
    second = comes(frames, shows(70))
    (folder / "notes.txt").write_text("no photograph")
    (folder / ".part.jpg").write_bytes(encoded(".jpg", 200))
    for _ in range(5):
        assert shows(70)(next(frames))
    (folder / "0000.jpg").write_bytes(encoded(".jpg", 150))
    third = comes(frames, shows(150))
    assert first.sequence < second.sequence < third.sequence and first.captured_s < second.captured_s < third.captured_s
    assert source.status is None


def test_an_empty_folder_and_one_that_goes_away_are_waited_for(tmp_path: Path) -> None:
    folder = tmp_path / "later"
    folder.mkdir()
    source = WatchedFolderSource(folder, fps=200.0)
    assert source._newer() is None and "waiting for the first photograph" in str(source.status)
    folder.rename(tmp_path / "away")
    assert source._newer() is None and "is gone" in str(source.status)
    (tmp_path / "away").rename(folder)
    assert source._newer() is None and "waiting for the first photograph" in str(source.status)
    (folder / "a.png").write_bytes(encoded(".png", 30))
    assert source._newer() is None and source._newer() is not None and source.status is None
    refused("there is none at", WatchedFolderSource, tmp_path / "absent")


def test_exif_becomes_the_state_of_the_lens(tmp_path: Path) -> None:
    """50 mm at f/2.8, focused 1.05 m from the film plane: from the lens that is s with s + s f / (s - f) = 1.05 m, 0.9975 m less
    0.0026: (1.05 + sqrt(1.05^2 - 4 * 1.05 * 0.05)) / 2 = 0.9972 m."""
    path, exif = tmp_path / "shot.jpg", Image.Exif()
    exif.get_ifd(0x8769).update({0x829D: 2.8, 0x920A: 50.0, 0x9206: 1.05})
    Image.fromarray(NOISE).save(path, exif=exif)
    lens = read_tethered(path, SizeLimit()).lens
    assert lens.f_number == pytest.approx(2.8) and lens.focal_length_mm == pytest.approx(50.0)
    assert lens.focus_distance_m == pytest.approx(0.9972, abs=2e-4)
    plain = tmp_path / "plain.png"
    Image.fromarray(NOISE).save(plain)
    assert read_tethered(plain, SizeLimit()).lens == LensState()


def test_photographs_of_a_real_camera_say_how_they_were_focused(shared_data: Path) -> None:
    """Named after their distances: what the Exif reader of mrbokeh finds comes through."""
    paths = sorted((shared_data / "exif").glob("*.jpg"))
    assert paths
    for path in paths:
        picture = read_tethered(path, SizeLimit(200, 200))
        assert max(picture.bgr.shape) <= 200
        facts = read_facts(path, (100, 100))
        assert picture.lens == LensState(facts.focus_distance_m, facts.f_number, facts.focal_length_mm)
        assert picture.lens.f_number is not None


def test_photographs_stand_upright_in_8_bit(tmp_path: Path) -> None:
    """Orientation 6 of Exif: to be turned clockwise by a quarter. Grey TIFF of 16 bit keeps its upper 8."""
    path, exif = tmp_path / "turned.png", Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(NOISE).save(path, exif=exif)
    np.testing.assert_array_equal(read_tethered(path, SizeLimit()).bgr, np.rot90(NOISE, -1)[..., ::-1])
    grey = tmp_path / "grey.tif"
    Image.fromarray(NOISE[..., 0].astype(np.uint16) * 257).save(grey)
    np.testing.assert_array_equal(read_tethered(grey, SizeLimit()).bgr[..., 1], NOISE[..., 0])
    half = read_tethered(path, SizeLimit(height_px=48)).bgr
    assert half.shape == (48, 32, 3)


def test_what_is_no_photograph_is_not_whole(tmp_path: Path) -> None:
    """Pillow puts the directory of an uncompressed TIFF first, so that only its pixels are missing while it is written."""
    path, plain = tmp_path / "x.jpg", BytesIO()
    Image.fromarray(NOISE).save(plain, "tiff")
    for data in (b"", b"not a picture", encoded(".jpg", 9)[:-200], encoded(".jpg", 9)[:2], plain.getvalue()[:-200]):
        path.write_bytes(data)
        with pytest.raises(NotWholeError, match=r"x\.jpg cannot be read"):
            read_tethered(path, SizeLimit())
    path.write_bytes(plain.getvalue())
    np.testing.assert_array_equal(read_tethered(path, SizeLimit()).bgr, NOISE[..., ::-1])


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    pictures = [linear_from_code(np.full((HEIGHT, WIDTH, 3), code), "bt709") for code in (0.2, 0.4, 0.6, 0.8)]
    return filmed(tmp_path / "clip.mkv", pictures, 50)


def test_a_video_goes_round_in_its_own_size(clip: Path) -> None:
    source, stopping = open_source(str(clip)), Event()
    assert source.name == "clip.mkv" and source.transfer == "bt709" and source.status is None
    frames = source.frames(stopping)
    got = [next(frames) for _ in range(9)]
    assert [each.sequence for each in got] == list(range(9))
    assert all(each.bgr.shape == (HEIGHT, WIDTH, 3) for each in got)
    np.testing.assert_array_equal(got[0].bgr, got[4].bgr)
    assert np.abs(got[1].bgr.astype(int) - got[0].bgr).min() > 30
    stopping.set()
    assert next(frames, None) is None


def test_a_real_film_comes_upright_and_small(shared_data: Path) -> None:
    path = shared_data / "video" / "iphone_xr_chart.mov"
    info = probe(path)
    frames = open_source(str(path), SizeLimit(200, 200)).frames(Event())
    height_px, width_px = next(frames).bgr.shape[:2]
    assert (width_px, height_px) == SizeLimit(200, 200).fit(info.width_px, info.height_px)
    frames.close()  # type: ignore[attr-defined]


def test_sizes_keep_their_aspect_and_never_grow() -> None:
    for limit, size, fitted in (
        (SizeLimit(640, 640), (1920, 1080), (640, 360)), (SizeLimit(height_px=360), (1080, 1920), (202, 360)),
        (SizeLimit(), (3, 5), (3, 5)), (SizeLimit(4000, 4000), (640, 480), (640, 480)), (SizeLimit(1, 1), (4000, 3), (1, 1)),
    ):  # fmt: skip
        assert limit.fit(*size) == fitted
    small = np.full((4, 6, 3), 7, np.uint8)
    assert SizeLimit(100, 100).applied(small) is small
    # Areas: four pixels become their mean.
    checks = np.repeat((np.indices((4, 6)).sum(axis=0) % 2 * 200).astype(np.uint8)[..., None], 3, axis=2)
    np.testing.assert_array_equal(SizeLimit(3).applied(checks), np.full((2, 3, 3), 100))


def test_what_is_late_is_not_hurried_after() -> None:
    """A clock of our own: 1 s of delay at the second frame moves all later ones by 1 s."""
    now_s, waits = [0.0], list[float]()

    class Stopping(Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append(timeout or 0.0)
            now_s[0] += timeout or 0.0
            return False

    rhythm = Rhythm(Stopping(), lambda: now_s[0])
    assert rhythm.wait_for(5.0) and rhythm.wait_for(5.1)
    now_s[0] += 1.0
    assert rhythm.wait_for(5.2) and rhythm.wait_for(5.3)
    rhythm.restart(0.1)
    assert rhythm.wait_for(5.0)
    np.testing.assert_allclose(waits, [0.0, 0.1, 0.0, 0.1, 0.1], atol=1e-9)


def test_words_and_addresses_open_what_they_name(tmp_path: Path, clip: Path) -> None:
    named = {"test": "test pattern", str(clip): "clip.mkv", f"folder:{tmp_path}": f"folder {tmp_path.name}", "whip": "browser camera"}
    named |= {address: address for address in ("rtsp://camera/stream", "https://host/cam.m3u8")} | {"udp://@:5000": "udp://:5000"}
    for text, name in named.items():
        source = open_source(text, SizeLimit(80, 60))
        assert isinstance(source, FrameSource) and source.name == name, text
    assert next(open_source("test").frames(Event())).bgr.shape == (360, 640, 3)


def test_anything_else_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for text, sentence in (
        ("absent.mp4", "none of them"), ("", "none of them"), ("srt://host:9000", "MediaMTX"), ("rtmp://host/live", "MediaMTX"),
        ("gopher://host", "expected a URL of rtsp"), ("folder:", "expected the folder"), ("folder:/absent/here", "there is none at"),
        ("whip:8080", "whip alone"), ("987", "cannot be opened"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=sentence) as caught:
            open_source(text)
        assert "\n" not in str(caught.value)
    refused("--max-rate", open_source, "test", fps=0.0)
    monkeypatch.setattr("viewfinder.sources.choose.find_spec", lambda _name: None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[viewfinder\]"):
        open_source("whip")
