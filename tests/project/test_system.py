"""What lies below everything: progress where nobody watches (plain lines now and then, and one at the end of what took long), memory
that is handed out again, which tethered camera is meant, and what its errors mean."""

import io
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np
import pytest
from rich.console import Console

from mrbokeh.system import console
from mrbokeh.system.console import PlainLines, track
from mrbokeh.system.errors import InputError
from mrbokeh.system.gphoto2_library import NoCameraError, chosen_of, explanation, library
from mrbokeh.system.messages import opened
from mrbokeh.system.resources import ZeroedMemory


class Clock:
    now_s = 100.0


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def said(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """What progress tells a file, with the time of the clock."""
    log = io.StringIO()
    monkeypatch.setattr(console, "PlainLines", lambda console: PlainLines(console, get_time=lambda: clock.now_s))
    monkeypatch.setattr(console, "Console", lambda **_: Console(file=log, force_terminal=False, width=40))
    return log


def slow(clock: Clock, count: int, each_s: float) -> Iterator[int]:
    for number in range(count):
        clock.now_s += each_s
        yield number


def test_lines_come_every_ten_seconds_and_at_the_end(clock: Clock, said: io.StringIO) -> None:
    """12 items of 4 s: lines at the first item beyond 10 s each time, and at 48 s."""
    assert list(track(slow(clock, 12, 4.0), "shooting", 12)) == list(range(12))
    assert said.getvalue().splitlines() == [
        "shooting: 3 of 12, 0:00:12, about 0:00:36 left",
        "shooting: 6 of 12, 0:00:24, about 0:00:24 left",
        "shooting: 9 of 12, 0:00:36, about 0:00:12 left",
        "shooting: 12 of 12, 0:00:48",
    ]


def test_work_that_is_gone_on_with_is_timed_from_there(clock: Clock, said: io.StringIO) -> None:
    """80 of 100 were done before; 10 more in 20 s leave as many for another 20 s."""
    with console.progress_bars() as bars:
        task = bars.add_task("train", total=100, completed=80)
        for _ in slow(clock, 10, 2.0):
            bars.advance(task)
    assert said.getvalue().splitlines()[-1] == "train: 90 of 100, 0:00:20, about 0:00:20 left"


def test_long_work_is_told_less_and_less_often(clock: Clock, said: io.StringIO) -> None:
    """An hour in seconds: ten lines in the first 100 s, and one for each twentieth of the time from 200 s on, 1.05^n."""
    list(track(slow(clock, 3600, 1.0), "train", 3600))
    lines = said.getvalue().splitlines()
    assert sum(int(line.split()[1]) <= 100 for line in lines) == 10 and 60 < len(lines) < 85


def test_silent_work_says_in_a_log_that_it_goes_on(
    clock: Clock, said: io.StringIO, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A command whose parts nobody counts, then a task whose first part takes long: one heartbeat each."""
    monkeypatch.setattr(console, "SILENT_S", 0.05)
    monkeypatch.setattr(console, "SILENT_MORE", 1e6)
    errors = ""

    def heard(word: str) -> None:
        nonlocal errors
        ends_s = time.monotonic() + 10.0
        while word not in errors and time.monotonic() < ends_s:
            time.sleep(0.01)
            errors += capsys.readouterr().err
        assert word in errors

    with opened():
        console.begin("export")
        heard("export: at work, 0:00:0")
        with console.progress_bars() as bars:
            bars.add_task("slices", total=5)
            clock.now_s += 60.0
            heard("slices: 0 of 5, 0:01:00")
    assert said.getvalue() == "slices: 0 of 5, 0:01:00\n", "the end of what was broken off"
    time.sleep(0.2)
    assert capsys.readouterr().err == "", "nothing after the command"


@pytest.mark.usefixtures("said")
def test_a_task_is_told_of_only_when_all_of_it_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread of the heartbeat asks in the middle of `add_task`, where rich calls `refresh`."""
    with console.progress_bars() as bars, ThreadPoolExecutor(1) as pool:
        asked: list[Future[str]] = []

        def refresh() -> None:
            asked.append(pool.submit(bars._silent_line))  # type: ignore[attr-defined]
            wait(asked, 0.2)

        monkeypatch.setattr(bars, "refresh", refresh)
        bars.add_task("slices", total=5)
        assert asked[0].result() == ""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("file", "environment"), [(Terminal(), {"TERM": "dumb"}), (io.StringIO(), {"FORCE_COLOR": "1"})])
def test_nothing_is_drawn_where_nothing_can_be_erased(
    file: io.StringIO, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a dumb terminal, and in a log whose colours are forced, as those of CI: a heartbeat, and no line that is not asked for."""
    monkeypatch.setattr(console, "Console", lambda **_: Console(file=file, _environ=environment))
    with opened() as channel:
        console.begin("export")
        assert isinstance(channel.spinner, console.Heartbeat)
        with console.working("rendering"):
            list(track([1, 2], "kernels"))
    assert file.getvalue() == ""


@pytest.mark.parametrize(("total", "lines"), [(0, ["frames: 4, 0:00:08"]), (2, ["frames: 2 of 2, 0:00:04", "frames: 4 of 2, 0:00:08"])])
def test_a_wrong_total_is_no_flood_of_lines(clock: Clock, said: io.StringIO, total: int, lines: list[str]) -> None:
    """Clips that state no number of frames give 0, others too few: the stated end, where there is one, and the last."""
    list(track(slow(clock, 4, 2.0), "frames", total))
    assert said.getvalue().splitlines() == lines


def test_what_is_done_at_once_leaves_no_line_and_what_is_broken_off_says_how_far_it_was(clock: Clock, said: io.StringIO) -> None:
    list(track(slow(clock, 5, 0.1), "kernels", 5))
    list(track([], "nothing"))
    assert said.getvalue() == ""
    for number in track(slow(clock, 5, 3.0), "slices", 5):
        if number == 1:
            break
    assert said.getvalue().splitlines() == ["slices: 1 of 5, 0:00:06, about 0:00:24 left"]


def test_counts_that_are_set_and_totals_that_come_later(clock: Clock, said: io.StringIO) -> None:
    """As COLMAP's stages are shown; and a number that nobody knows the end of."""
    with console.progress_bars() as bars:
        features, frames = bars.add_task("features", total=None), bars.add_task("frames", total=None)
        clock.now_s += 11.0
        bars.update(features, completed=4, total=8)
        bars.update(features, completed=4, total=8)
        bars.advance(frames)
        clock.now_s += 1.0
        bars.update(features, completed=8)
    assert said.getvalue().splitlines() == [
        "features: 4 of 8, 0:00:11, about 0:00:11 left",
        "frames: 1, 0:00:11",
        "features: 8 of 8, 0:00:12",
    ]


def test_memory_that_is_given_back_as_zeros_is_handed_out_again_if_it_is_large_enough() -> None:
    memory = ZeroedMemory()
    first = memory.take(100, np.float32)
    assert first.size == 100 and first.dtype == np.float32 and not first.any()
    memory.give_back(first)
    assert memory.take(80, np.float32) is first
    assert memory.take(80, np.float32) is not first, "one array to one taker"
    memory.give_back(first)
    assert memory.take(101, np.float32).size == 101 and memory.take(80, np.float64).dtype == np.float64


def test_what_is_too_large_is_not_kept() -> None:
    memory = ZeroedMemory(most_bytes=400)
    small, large = memory.take(100, np.float32), memory.take(101, np.float32)
    memory.give_back(large)
    memory.give_back(small)
    assert memory.take(1, np.float32) is small and memory.take(1, np.float32) is not large


TWO = [("A", "usb:001,001"), ("B", "usb:001,002")]


class GPhoto2Error(Exception):
    """As gphoto2 has it."""

    def __init__(self, code: int, string: str = "") -> None:
        super().__init__(f"[{code}] {string}")
        self.code, self.string = code, string


def test_the_only_camera_or_the_one_that_is_named() -> None:
    assert chosen_of(TWO[:1], None, "--camera") == TWO[0] and chosen_of(TWO, "usb:001,002", "--camera") == TWO[1]


def test_a_camera_that_is_not_there() -> None:
    for found, port, sentence in (
        ([], None, "no camera found.*udev"), ([], "usb:001,001", "no camera found.*udev"),
        (TWO, "usb:009,009", "no camera at usb:009,009, only at A at usb:001,001, B at usb:001,002"),
    ):  # fmt: skip
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
        "another program": (gp.GP_ERROR_IO_USB_CLAIM, gp.GP_ERROR_IO_LOCK), "not there any more": (gp.GP_ERROR_IO_USB_FIND,),
        "connection broke": (gp.GP_ERROR_IO, gp.GP_ERROR_IO_READ, gp.GP_ERROR_IO_WRITE), "in time": (gp.GP_ERROR_TIMEOUT,),
        "busy": (gp.GP_ERROR_CAMERA_BUSY,),
    }  # fmt: skip
    assert all(words in explanation(gp.GPhoto2Error(code)) for words, codes in expected.items() for code in codes)
