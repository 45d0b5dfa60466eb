"""The virtual layer as colour above alpha; tests/live/test_streaming_browser.py puts it together in Chromium."""

import threading

import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay, code_tables
from mrbokeh.video.color import code_from_linear
from tests.live.test_streaming_fan_out import ignore, taken, until
from tests.scenes.streaming_viewers import output, streaming
from viewfinder.streaming.alpha_stream import AlphaStream, color_over_alpha


def overlay(light: list[float], alpha: float, rows: int = 4, top_px: int = 2) -> Overlay:
    rgb = np.broadcast_to(np.array(light, np.float32), (rows, 6, 3)).copy()
    return Overlay(top_px, 1, rgb, np.full((rows, 6), 1 - alpha, np.float32))


@pytest.mark.parametrize(
    ("light", "alpha", "surface", "glow"),
    [
        # An opaque surface shows its own code; half covered, half of that; light without coverage adds its own code.
        ([0.5, 0.2, 0.1], 1.0, [0.5, 0.2, 0.1], [0, 0, 0]),
        ([0.25, 0.1, 0.05], 0.5, [0.5, 0.2, 0.1], [0, 0, 0]),
        ([0.3, 0.0, 0.2], 0.0, [0, 0, 0], [0.3, 0.0, 0.2]),
        # 0.6 on half coverage: as white as the surface can be, and 0.1 of glow.
        ([0.6, 0.1, 0.0], 0.5, [1.0, 0.2, 0.0], [0.1, 0, 0]),
    ],
)
def test_halves_hold_premultiplied_codes_and_alpha(light: list[float], alpha: float, surface: list[float], glow: list[float]) -> None:
    picture = color_over_alpha(overlay(light, alpha), 10, 8, "srgb")
    assert picture.shape == (16, 10, 3)
    codes = alpha * code_from_linear(np.array(surface, np.float32), "srgb") + code_from_linear(np.array(glow, np.float32), "srgb")
    np.testing.assert_allclose(picture[3, 3, ::-1], np.minimum(255 * codes, 255), atol=0.51)
    assert picture[8 + 3, 3].tolist() == [round(255 * alpha)] * 3
    # Nothing lies outside the box of the overlay, in neither half.
    outside = np.ones((8, 10), bool)
    outside[2:6, 1:7] = False
    assert not picture[:8][outside].any()
    assert not picture[8:][outside].any()


def test_over_a_camera_it_gives_what_our_own_composite_gives_where_alpha_is_whole() -> None:
    plate = np.full((8, 10, 3), 90, np.uint8)
    layer = overlay([0.5, 0.2, 0.1], 1.0)
    picture = color_over_alpha(layer, 10, 8, "srgb").astype(int)
    composite = np.rint(picture[:8] + plate * (1 - picture[8:] / 255))
    np.testing.assert_allclose(composite, layer.over_codes(plate, code_tables("srgb")), atol=1)


def test_an_odd_height_and_an_empty_overlay_are_no_trouble() -> None:
    picture = color_over_alpha(overlay([0.5, 0.5, 0.5], 1.0, rows=4, top_px=5), 10, 9, "srgb")
    # The ninth row is left out, so that the seam lies between two rows of chroma.
    assert picture.shape == (16, 10, 3)
    assert picture[5:8, 1:7].all()
    assert picture[8 + 5 : 16, 1:7].all()
    assert not picture[8 : 8 + 5].any()
    empty = Overlay(0, 0, np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.float32))
    assert not color_over_alpha(empty, 10, 8, "srgb").any()


def test_pictures_go_to_a_stream_of_their_own_with_the_times_of_the_camera() -> None:
    with streaming() as stream:
        alpha = AlphaStream(stream, "srgb")
        assert not alpha.wants_frame
        viewer = stream.watch("H264", ignore)
        assert alpha.wants_frame
        alpha.show(overlay([0.5, 0.5, 0.5], 1.0), output(np.zeros((90, 160, 3), np.uint8), 7, 12.5))
        until(lambda: viewer.waiting)
        (frame,) = taken(viewer)
        assert (frame.captured_s, frame.header["sequence"]) == (12.5, 7)
        assert stream._encoders["H264"].size_px == (160, 180)
        alpha.fail("the camera was unplugged")
        assert viewer.failure == "the camera was unplugged"
        alpha.close()
    assert not any(thread.name in ("alpha", "encode") for thread in threading.enumerate())
