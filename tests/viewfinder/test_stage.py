"""The stage as the compositing thread sees it: drawings come beside the stream, move with it, fade, and follow the scene file."""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import make_renderer
from mrbokeh.system.errors import InputError
from tests.scene.test_scene_gltf import GlbWriter
from tests.support.refusals import refused
from tests.support.stage_scenes import FOCAL_PX, HEIGHT, LENS, ONE_CARD, WIDTH, backend, camera, centroid, scene_file
from viewfinder.stage.shown_scene import preparing
from viewfinder.stage.stage import FADE_S, AdaptiveResolution, Fade, Stage
from viewfinder.stage.stage_setup import live_renderer
from viewfinder.tracking.tracker import TrackedPose

BLACK = np.zeros((HEIGHT, WIDTH, 3), np.float32)
PATIENCE_S = 60.0


def aside(right_m: float) -> Camera:
    """The camera, moved to the right."""
    return camera((right_m, 1.0, -0.1), (right_m, 0.0, -0.1))


def pose_of(view: Camera) -> TrackedPose:
    return TrackedPose(view.camera_from_world, 1.0, 0.0)


class Stream:
    """A compositing thread in small: frames of one camera, 30 to the second of their own time."""

    def __init__(self, stage: Stage, view: Camera, lens: Lens = LENS) -> None:
        self.stage, self.view, self.lens, self.time_s = stage, view, lens, 100.0

    def frame(self, tracked: bool = True) -> Overlay:
        self.time_s += 1 / 30
        return self.stage.overlay(pose_of(self.view) if tracked else None, self.view, self.lens, self.time_s)

    def until(self, fulfilled: Callable[[], bool]) -> Overlay:
        """Frames until something is so; the test fails where it never is."""
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            overlay = self.frame()
            if fulfilled():
                return overlay
            time.sleep(0.005)
        raise AssertionError(f"not within {PATIENCE_S} s; the stage says: {self.stage.status}")

    def settled(self) -> Overlay:
        """Frames until what is shown is drawn for this very view and lens."""
        return self.until(lambda: self.stage.seen is not None and self._is_fresh())

    def _is_fresh(self) -> bool:
        request = self.stage.seen.drawing.request
        same_pose = np.array_equal(request.camera.camera_from_world, self.view.camera_from_world)
        return same_pose and request.camera.width_px == self.view.width_px and request.lens == self.lens


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with closing(Stage(scene_file(tmp_path, ONE_CARD), backend())) as opened:
        yield opened


def centre_px(overlay: Overlay, view: Camera) -> tuple[float, float]:
    return centroid(overlay.over(np.zeros((view.height_px, view.width_px, 3), np.float32))[..., 0])


def rewrite(path: Path, content: str | bytes) -> None:
    """As an editor does; with a time of its own, however coarse the clock of the file system is."""
    before_s = path.stat().st_mtime
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    os.utime(path, (before_s + 2.0, before_s + 2.0))


def test_the_object_appears_where_it_stands_and_moves_with_every_frame(stage: Stage) -> None:
    stream = Stream(stage, camera())
    assert not stream.frame().shines_through.size or stage.seen is not None
    assert centre_px(stream.settled(), camera()) == pytest.approx((80, 56), abs=0.05)
    # 2 cm to the right at 1 m are 3 px; the very next frame shows it, drawn or not.
    stream.view = aside(0.02)
    assert centre_px(stream.frame(), camera())[0] == pytest.approx(80 - FOCAL_PX * 0.02, abs=0.1)


def test_it_says_why_nothing_is_seen_and_where_the_object_is(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viewfinder.stage.shown_scene.kernels_compiled", lambda: 3)
    assert preparing(busy=True).startswith("preparing the scene; compiling for this machine, kernel 3: ")
    stream = Stream(stage, camera())
    while stage.seen is None:
        stream.frame()
        assert stage.seen is not None or stage.remark is not None
    stream.settled()
    assert stage.remark is None
    # From 2 m to its left it lies to the right, from 2 m above it below; who turned round has it behind, and to the left.
    for view, word, arrow in (
        (aside(-2.0), "outside", (1.0, 0.0)),
        (camera((0.0, 1.0, -2.1), (0.0, 0.0, -2.1)), "outside", (0.0, 1.0)),
        (camera((-0.5, 1.0, -0.1), (-0.5, 2.0, -0.1)), "behind", (-1.0, 0.0)),
    ):
        stream.view = view
        stream.until(lambda word=word: stage.remark is not None and word in stage.remark.sentence)
        assert stage.remark.arrow == pytest.approx(arrow, abs=0.05)
    # On the way back it says nothing wrong before the new drawing is there.
    stream.view = camera()
    while not stream.frame().rgb.size:
        assert stage.remark is None or stage.remark.arrow is not None
    stage.show_object("card", False)
    stream.until(lambda: stage.remark is not None)
    assert stage.remark == ("every object is hidden: show one", None)


def test_nothing_is_drawn_again_when_nothing_moved(stage: Stage) -> None:
    stream = Stream(stage, camera())
    stream.settled()
    status, drawing = stage.status, stage.seen.drawing
    assert status.triangles == 2 and status.problem is None and status.renderer == "polygon" and status.resolution == 1.0
    assert status.layer_age_ms is not None and 0.0 <= status.layer_age_ms < 1e3 * PATIENCE_S and status.draws_per_s > 0
    for _ in range(60):
        stream.frame()
        # Jitter of a third of a pixel is moved, not drawn.
        stream.view = aside(0.002 * float(np.sin(stream.time_s * 40)))
        time.sleep(0.003)
    assert stage.seen.drawing is drawing and not stage.status.busy
    stream.view = aside(0.05)
    stream.settled()
    assert stage.seen.drawing is not drawing


def test_another_focus_is_pending_until_it_is_drawn(stage: Stage) -> None:
    stream = Stream(stage, camera())
    stream.settled()
    assert not stage.status.focus_pending
    sharp = stream.frame()
    stream.lens = LENS.focused_at(0.3)
    stream.frame()
    assert stage.status.focus_pending
    blurred = stream.settled()
    assert stage.status.lens == stream.lens and not stage.status.focus_pending
    # 2.9 * (1 / 0.3 - 1) = 7 px of blur make the box larger.
    assert blurred.shines_through.size > sharp.shines_through.size


def test_a_lost_track_fades_within_half_a_second_where_it_was_and_comes_back(stage: Stage) -> None:
    stream = Stream(stage, camera())
    full = float(stream.settled().rgb.sum())
    levels = [float(stream.frame(tracked=False).rgb.sum()) / full for _ in range(16)]
    # 1/30 s of 1/2 s a frame.
    assert levels[:3] == pytest.approx([14 / 15, 13 / 15, 12 / 15], abs=0.01) and levels[-1] == 0.0
    assert stage.status.opacity == 0.0
    back = [float(stream.frame().rgb.sum()) / full for _ in range(16)]
    assert back[:2] == pytest.approx([1 / 15, 2 / 15], abs=0.01) and back[-1] == pytest.approx(1.0)


def test_an_unsure_pose_shows_nothing_at_first_and_fades_what_was_there(stage: Stage) -> None:
    """As no pose. After a certain one, the object is gone within the half second of a lost track, and comes back."""

    def least_through(is_certain: bool, time_s: float) -> float:
        pose = TrackedPose(camera().camera_from_world, 0.2, time_s, is_certain=is_certain)
        return float(stage.overlay(pose, camera(), LENS, time_s).shines_through.min(initial=1.0))

    stream = Stream(stage, camera())
    assert not stream.frame(tracked=False).shines_through.size and stage.status.layer_age_ms is None
    assert least_through(False, stream.time_s) == 1.0
    stream.until(lambda: stage.status.layer_age_ms is not None)
    time_s = stream.time_s + 1.0
    assert least_through(True, time_s) < 0.1
    assert least_through(False, time_s + 0.5 * FADE_S) == pytest.approx(0.5, abs=0.06)
    assert least_through(False, time_s + FADE_S) == 1.0 and least_through(True, time_s + 2.5 * FADE_S) < 0.1


def test_another_size_of_frames(stage: Stage) -> None:
    stream = Stream(stage, camera())
    stream.settled()
    stream.view = camera().resized(80, 56)
    # What was drawn for the old size is shown in the new one until there is a new drawing.
    assert centre_px(stream.frame(), stream.view) == pytest.approx((40, 28), abs=0.1)
    assert centre_px(stream.settled(), stream.view) == pytest.approx((40, 28), abs=0.1)


def test_the_scene_file_and_its_glb_are_followed_and_a_mistake_keeps_the_old_scene(stage: Stage, tmp_path: Path) -> None:
    stream = Stream(stage, camera())
    stream.settled()
    path, glb = tmp_path / "scene.toml", tmp_path / "card.glb"
    rewrite(path, ONE_CARD + "position_m = [0.2, 0, 0]\n")
    stream.until(lambda: centre_px(stream.frame(), camera())[0] > 109)
    assert centre_px(stream.frame(), camera())[0] == pytest.approx(80 + FOCAL_PX * 0.2, abs=0.05)
    rewrite(path, ONE_CARD + "position_m = [0.2, 0\n")
    stream.until(lambda: stage.status.problem is not None)
    assert "scene.toml" in str(stage.status.problem) and centre_px(stream.frame(), camera())[0] > 109
    rewrite(path, ONE_CARD)
    stream.until(lambda: stage.status.problem is None and centre_px(stream.frame(), camera())[0] < 81)
    writer = GlbWriter()
    writer.square({"emissiveFactor": [0.0, 1.0, 0.0], "doubleSided": True, "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}})
    rewrite(glb, writer.write(tmp_path / "green.glb").read_bytes())
    stream.until(lambda: bool(stream.frame().over(BLACK)[56, 80, 0] < 0.1))
    assert stream.frame().over(BLACK)[56, 80, 1] == pytest.approx(1.0, abs=0.05)
    # A half-written file is told, and the object stays.
    rewrite(glb, b"glTF")
    stream.until(lambda: stage.status.problem is not None)
    assert stream.frame().over(BLACK)[56, 80, 1] == pytest.approx(1.0, abs=0.05)


def test_objects_are_moved_and_hidden(stage: Stage) -> None:
    stream = Stream(stage, camera())
    stream.settled()
    assert [each.name for each in stage.objects] == ["card"]
    stage.move_object("card", (-0.1, 0.0, 0.0))
    stream.until(lambda: centre_px(stream.frame(), camera())[0] < 66)
    stage.show_object("card", False)
    stream.until(lambda: not stream.frame().shines_through.size)
    stage.show_object("card", True)
    stream.until(lambda: bool(stream.frame().shines_through.size))
    refused("expected the name of an object", stage.move_object, "lamp", (0.0, 0.0, 0.0))


class Refusing:
    """A Renderer that knows no lens."""

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:  # noqa: ARG002
        raise InputError("this renderer knows no such lens")


class Slow:
    """A Renderer that takes its time and counts."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.inner, self.times = seconds, make_renderer("polygon", threads=1), 0

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        self.times += 1
        time.sleep(self.seconds)
        return self.inner.render(layers, lens)


def test_renderers_are_switched_and_one_that_refuses_leaves_the_picture(stage: Stage) -> None:
    stream = Stream(stage, camera())
    stream.settled()
    refused("expected a renderer", live_renderer, "crystal ball")
    refusing: Renderer = Refusing()
    stage.set_renderer("refusing", refusing)
    stream.until(lambda: stage.status.problem is not None)
    assert "knows no such lens" in str(stage.status.problem) and stream.frame().shines_through.size
    stage.set_renderer("low-rank", live_renderer("low-rank"))
    stream.until(lambda: stage.status.problem is None and stage.status.renderer == "low-rank")


def test_frames_do_not_wait_for_drawings_and_the_newest_request_wins(stage: Stage) -> None:
    slow = Slow(0.15)
    stage.set_renderer("slow", slow)
    stream = Stream(stage, camera())
    stream.settled()
    drawn_before = slow.times
    for step in range(30):
        stream.view = aside(0.01 * step)
        overlay = stream.frame()
        assert centre_px(overlay, camera())[0] == pytest.approx(80 - FOCAL_PX * 0.01 * step, abs=0.5)
        time.sleep(0.005)
    stream.settled()
    # 30 views within a third of a second: the drawing under way, those that fit, and the last.
    assert slow.times - drawn_before < 10


def test_slow_drawings_get_coarser_and_still_ones_fine_again(stage: Stage) -> None:
    stage.set_renderer("slow", Slow(0.15))
    stream = Stream(stage, camera())
    stream.settled()

    def moving_and_coarse() -> bool:
        stream.view = aside(0.05 * float(np.sin(stream.time_s)))
        return stage.status.resolution == 0.5

    stream.until(moving_and_coarse)
    stream.until(lambda: stage.status.resolution == 1.0 and stream._is_fresh())


def test_what_is_animated_is_drawn_again_and_again(tmp_path: Path) -> None:
    writer = GlbWriter()
    writer.square({"emissiveFactor": [1.0, 1.0, 1.0], "doubleSided": True})
    steps = writer.accessor(np.array([0.0, 0.3], np.float32), "SCALAR")
    places = writer.accessor(np.array([[0, 0, 0], [4, 0, 0]], np.float32), "VEC3")
    channels = [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]
    writer.json["animations"] = [{"name": "go", "samplers": [{"input": steps, "output": places}], "channels": channels}]
    writer.write(tmp_path / "moving.glb")
    path = tmp_path / "scene.toml"
    path.write_text('[[object]]\nname = "m"\nglb = "moving.glb"\nheight_m = 0.1\nanimation = "go"\nloop = false\n')
    with closing(Stage(path, backend())) as stage:
        stream = Stream(stage, camera((0.0, 1.0, -0.05), (0.0, 0.0, -0.05)))
        stream.until(lambda: stage.seen is not None and stage.seen.drawing.request.time_s > 0.3)
        # 4 m of a square of 2 m that is scaled to 0.1 m are 0.2 m; then it stands still there.
        assert centre_px(stream.frame(), camera())[0] == pytest.approx(80 + FOCAL_PX * 0.2, abs=0.1)


def test_the_lens_of_the_file_and_a_file_that_is_wrong_and_the_thread_ends_with_the_stage(tmp_path: Path) -> None:
    write_lens(tmp_path / "lens.json", LENS)
    before = threading.active_count()
    with closing(Stage(scene_file(tmp_path, ONE_CARD + "[lens]\nfile = 'lens.json'\n"), backend())) as stage:
        assert stage.lens is not None and replace(stage.lens, aperture=LENS.aperture) == LENS
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
    refused("expected a scene file", Stage, tmp_path / "other.toml", backend())


def test_fading_goes_by_the_time_of_frames() -> None:
    fade = Fade()
    assert [fade.at(False, time_s) for time_s in (5.0, 5.1, 5.1, 4.0)] == pytest.approx([1.0, 0.8, 0.8, 0.8])
    assert fade.at(False, 9.0) == 0.0 and fade.at(True, 9.25) == pytest.approx(0.5) and fade.at(True, 99.0) == 1.0


def test_resolution_follows_the_time_that_drawings_take() -> None:
    resolution = AdaptiveResolution()
    for took_s, now in ((0.1, 1.0), (0.2, 0.75), (0.2, 0.5), (0.2, 0.5), (0.05, 0.5), (0.04, 0.75), (0.06, 0.75), (0.05, 1.0)):
        # At 3/4 a drawing of 1/8 s at all pixels takes 9/16 of that; a fifth of the time is kept as a reserve.
        resolution.took(resolution.now, took_s)
        assert resolution.now == now
