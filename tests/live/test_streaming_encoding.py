"""From pictures to packets and files: luma and chroma by H.273, what H.264 and VP8 make of them. The decoder is FFmpeg's."""

import threading
import time
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import probe, read_frames
from mrbokeh.video.color import BT709, LIMITED, VideoColor, code_from_linear
from mrbokeh.video.frames import display_bgr
from tests.scenes.streaming_viewers import BARS, HEIGHT, WIDTH, bar_centres, bars, noise, output
from tests.scenes.waiting import wait_until
from viewfinder.frames import OutputFrame
from viewfinder.streaming.encoders import STREAM_COLOR, StreamQuality, VideoEncoder, h264_encoder, i420_frame, vp8_encoder
from viewfinder.streaming.recording import Recorder, Recording, recording_path

FULL_709 = VideoColor(matrix=1, code_range=2, transfer=1, primaries=1)
MAKERS = {"h264": h264_encoder, "libvpx": vp8_encoder}


def plain_i420(bgr: np.ndarray, color: VideoColor) -> list[np.ndarray]:
    """H.273, 8.3 as it is printed, in floating point: luma of each pixel, colour differences of the mean of 2x2."""
    red, blue = color.luma_weights
    bgr = bgr[: bgr.shape[0] & ~1, : bgr.shape[1] & ~1].astype(float) / 255

    def luma(picture: np.ndarray) -> np.ndarray:
        return picture @ np.array([blue, 1 - red - blue, red])

    quarter = bgr.reshape(bgr.shape[0] // 2, 2, bgr.shape[1] // 2, 2, 3).mean(axis=(1, 3))
    differences = [(quarter[..., 0] - luma(quarter)) / (2 * (1 - blue)), (quarter[..., 2] - luma(quarter)) / (2 * (1 - red))]
    limited = color.code_range == LIMITED
    planes = [16 + 219 * luma(bgr) if limited else 255 * luma(bgr), *(128 + (224 if limited else 255) * each for each in differences)]
    return [np.clip(plane, 0, 255) for plane in planes]


def planes_of(frame: Any) -> list[np.ndarray]:
    return [np.frombuffer(each, np.uint8).reshape(each.height, each.line_size)[:, : each.width] for each in frame.planes]


def nal_types(packet: Any) -> list[int]:
    """Types of the units of an H.264 packet: 1 refers to others, 5 stands alone (IDR), 7 and 8 are parameter sets, 6 is a remark."""
    return [part[0] & 31 for part in bytes(packet).replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")[1:]]


def decoded(codec: str, packets: list[Any]) -> list[Any]:
    decoder: Any = av.CodecContext.create(codec, "r")
    return [frame for packet in packets for frame in decoder.decode(av.Packet(bytes(packet)))] + decoder.decode(None)


def encode(encoder: VideoEncoder, pictures: list[np.ndarray]) -> list[Any]:
    return [encoder.encode(i420_frame(picture), 3000 * i) for i, picture in enumerate(pictures)]


@pytest.mark.parametrize("color", [STREAM_COLOR, BT709, FULL_709])
@pytest.mark.parametrize("size", [(64, 48), (31, 17)])
def test_the_conversion_agrees_with_the_formula(color: VideoColor, size: tuple[int, int]) -> None:
    bgr = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)
    for ours, plain in zip(planes_of(i420_frame(bgr, color)), plain_i420(bgr, color), strict=True):
        # Rounded to nearest: never further than half a code, and a trace for the integers of 2**-16.
        np.testing.assert_allclose(ours, plain, atol=0.51)


def test_bars_have_the_codes_of_bt601() -> None:
    """Studio codes of BT.601 at 100 %: white 235, black 16, red 81/90/240, green 145/54/34, blue 41/240/110; grey 128 is 125.9."""
    y, u, v = (bar_centres(plane[..., None])[:, 0] for plane in planes_of(i420_frame(bars(), STREAM_COLOR)))
    np.testing.assert_array_equal(y[:6], [16, 235, 81, 145, 41, 126])
    np.testing.assert_array_equal(u[:6], [128, 128, 90, 54, 240, 128])
    np.testing.assert_array_equal(v[:6], [128, 128, 240, 34, 110, 128])


@pytest.mark.parametrize("codec", MAKERS)
def test_colours_survive_encoding_and_the_stream_says_what_they_are(codec: str) -> None:
    encoder, started_s = MAKERS[codec](WIDTH, HEIGHT), time.perf_counter()
    frames = decoded(codec, encode(encoder, [bars()] * 10))
    assert len(frames) == 10 and 0 < encoder.encode_ms <= 1000 * (time.perf_counter() - started_s)
    shown = display_bgr(frames[-1], STREAM_COLOR, (WIDTH, HEIGHT))
    # Limited range has 219 steps for 255 codes, which alone costs up to 1; the quantiser of a flat area little more.
    np.testing.assert_allclose(bar_centres(shown), BARS.astype(int), atol=3)
    if codec == "h264":
        # H.273: matrix 6 is BT.601, range 1 is limited, transfer and primaries 1 are BT.709.
        assert (frames[0].colorspace, frames[0].color_range, frames[0].color_trc, frames[0].color_primaries) == (6, 1, 1, 1)


def test_h264_is_constrained_baseline_at_the_level_that_fits() -> None:
    """SPS: profile 66, constraint flags 0 and 1 set; level 1.3 has 396 macroblocks and 11880/s, 320x180 at 30 needs 240 and 7200/s.

    1280x720 at 30 needs 3600 and 108000/s, the limits of level 3.1. The bitrate is below the limits of both (768 kb/s, 14 Mb/s).
    """
    for size, bits_per_s, level in (((320, 180), 700_000, 13), ((1280, 720), 4_000_000, 31)):
        packet = encode(h264_encoder(*size, StreamQuality(bitrate_bps=bits_per_s)), [np.zeros((size[1], size[0], 3), np.uint8)])[0]
        assert nal_types(packet)[:2] == [7, 8]
        profile, constraints, found = bytes(packet)[5:8]
        assert (profile, constraints & 0xC0, found) == (66, 0xC0, level)


def test_each_picture_gives_its_packet_at_once_and_in_order() -> None:
    packets = encode(h264_encoder(WIDTH, HEIGHT), [noise(i) for i in range(12)])
    assert [packet.pts for packet in packets] == [3000 * i for i in range(12)] == [packet.dts for packet in packets]
    assert [set(nal_types(packet)) & {1, 5, 7, 8} for packet in packets] == [{5, 7, 8}] + [{1}] * 11


@pytest.mark.parametrize("codec", MAKERS)
def test_a_decoder_can_begin_at_a_forced_keyframe(codec: str) -> None:
    encoder = MAKERS[codec](WIDTH, HEIGHT)
    packets = encode(encoder, [noise(i) for i in range(5)])
    encoder.force_keyframe()
    packets += [encoder.encode(i420_frame(bars()), 3000 * i) for i in range(5, 9)]
    assert [bool(packet.is_keyframe) for packet in packets] == [i in (0, 5) for i in range(9)]
    if codec == "h264":
        assert set(nal_types(packets[5])) >= {5, 7, 8}
    whole, late = decoded(codec, packets), decoded(codec, packets[5:])
    assert len(late) == 4
    for a, b in zip(planes_of(whole[-1]), planes_of(late[-1]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("codec", MAKERS)
def test_the_bitrate_is_kept_and_no_picture_left_out(codec: str) -> None:
    """Two seconds of fresh noise, which nothing compresses, at 2 Mb/s."""
    packets = encode(MAKERS[codec](WIDTH, HEIGHT, StreamQuality(bitrate_bps=2_000_000)), [noise(i) for i in range(60)])
    bits = 8 * sum(packet.size for packet in packets)
    # The buffer (half a second, a second for VP8) may be spent besides.
    assert 2_000_000 < bits < 6_000_000
    assert len(decoded(codec, packets)) == 60


def test_the_bitrate_follows_the_size_within_bounds() -> None:
    assert StreamQuality().bits_per_s(1280, 720) == round(0.2 * 1280 * 720 * 30)
    assert StreamQuality().bits_per_s(320, 180) == 1_500_000
    assert StreamQuality().bits_per_s(3840, 2160) == 12_000_000
    assert StreamQuality(bitrate_bps=800_000).bits_per_s(1280, 720) == 800_000


# As a camera gives them: not evenly.
TIMES_S = [50.0, 50.033, 50.1, 50.101, 50.25]


def recorded(path: Path, frames: list[OutputFrame], transfer: str = "bt709") -> Recording:
    recorder = Recorder(transfer, waiting=len(frames))
    recorder.start(path)
    for frame in frames:
        recorder.show(frame)
    return recorder.stop()


@pytest.mark.parametrize(("name", "tolerance"), [("clip.mp4", 3), ("clip.mov", 2)])
def test_pictures_and_their_times_are_in_the_file(tmp_path: Path, name: str, tolerance: int) -> None:
    recording = recorded(tmp_path / name, [output(bars(), i, captured_s) for i, captured_s in enumerate(TIMES_S)])
    assert (recording.frame_count, recording.dropped, recording.note) == (5, 0, None)
    assert recording.duration_s == pytest.approx(0.25)
    frames = list(read_frames(recording.path))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.array(TIMES_S) - 50.0, atol=1e-5)
    # Codes of BT.709 go through linear light and back to where they were; limited range and the codec take 1 or 2.
    codes = 255 * code_from_linear(frames[-1].rgb[..., ::-1], "bt709")
    np.testing.assert_allclose(np.clip(np.rint(bar_centres(codes)), 0, 255), BARS.astype(int), atol=tolerance)
    # Light is what is kept where the camera has another curve: code 188 of sRGB is linear 0.503.
    grey = recorded(tmp_path / f"grey_{name}", [output(np.full((HEIGHT, WIDTH, 3), 188, np.uint8), 0, 1.0)], "srgb").path
    assert np.median(next(read_frames(grey)).rgb) == pytest.approx(0.503, abs=0.006) and probe(grey).color.transfer_name == "bt709"


def test_a_file_appears_when_it_is_whole_and_none_is_overwritten(tmp_path: Path) -> None:
    path, recorder = tmp_path / "clip.mp4", Recorder("bt709")
    assert not recorder.wants_frame
    recorder.start(path)
    assert recorder.wants_frame
    recorder.show(output(bars(), 0, 1.0))
    with pytest.raises(InputError, match="one recording at a time"):
        recorder.start(tmp_path / "other.mp4")
    assert not path.exists()
    recorder.stop()
    assert not recorder.wants_frame and list(tmp_path.iterdir()) == [path]
    for start, sentence in ((path, "exists already"), (tmp_path / "clip.gif", r"\.mp4")):
        with pytest.raises(InputError, match=sentence):
            recorder.start(start)
    with pytest.raises(InputError, match="none was started"):
        recorder.stop()
    recorder.show(output(bars(), 1, 2.0))
    # It can be used again; stopped before the first picture it waits for one.
    recorder.start(tmp_path / "second.mp4")
    late = threading.Timer(0.1, lambda: recorder.show(output(bars(), 2, 3.0)))
    late.start()
    assert recorder.stop().frame_count == 1
    first = recording_path(tmp_path, ".mov")
    first.touch()
    assert recording_path(tmp_path, ".mov") != first and first.suffix == ".mov"


def test_a_recording_of_nothing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viewfinder.streaming.recording._FIRST_PICTURE_S", 0.05)
    recorder = Recorder("bt709")
    recorder.start(tmp_path / "clip.mp4")
    with pytest.raises(InputError, match="at least one picture"):
        recorder.stop()
    assert list(tmp_path.iterdir()) == []
    recorder.start(tmp_path / "clip.mp4")
    for _ in range(2):
        recorder.close()
    assert not any(thread.name == "recorder" for thread in threading.enumerate())


def test_repeated_captures_and_clocks_that_step_back_are_left_out(tmp_path: Path) -> None:
    frames = [output(bars(), i, captured_s) for i, captured_s in enumerate([5.0, 5.1, 5.1, 5.05, 5.2])]
    recording = recorded(tmp_path / "clip.mp4", frames)
    assert recording.frame_count == 3
    np.testing.assert_allclose([frame.time_s for frame in read_frames(recording.path)], [0.0, 0.1, 0.2], atol=1e-5)


def test_a_change_of_size_ends_the_file_with_what_was_there(tmp_path: Path) -> None:
    frames = [output(bars(*size), i, 1 + i / 10) for i, size in enumerate([(320, 180), (320, 180), (160, 90), (160, 90)])]
    recording = recorded(tmp_path / "clip.mp4", frames)
    assert recording.frame_count == len(list(read_frames(recording.path))) == 2 and "320x180" in str(recording.note)


def test_a_last_odd_row_and_column_are_left_out_of_mp4_only(tmp_path: Path) -> None:
    for name, size in (("odd.mp4", (160, 90)), ("odd.mov", (161, 91))):
        info = probe(recorded(tmp_path / name, [output(bars(161, 91), 0, 1.0)]).path)
        assert (info.width_px, info.height_px) == size


def test_pictures_that_come_too_fast_are_counted(tmp_path: Path) -> None:
    recorder = Recorder("bt709", waiting=2)
    recorder.start(tmp_path / "clip.mp4")
    for i in range(200):
        recorder.show(output(bars(), i, i / 30))
    recording = recorder.stop()
    assert recording.dropped > 0
    assert recording.frame_count + recording.dropped == 200


def test_a_disk_that_refuses_gives_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    recorder = Recorder("bt709")
    recorder.start(tmp_path / "file" / "clip.mp4")
    recorder.show(output(bars(), 0, 1.0))
    wait_until(lambda: not recorder.wants_frame)
    with pytest.raises(InputError, match="could not be written"):
        recorder.stop()
