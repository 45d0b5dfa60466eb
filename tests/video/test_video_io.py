"""Videos: what goes in comes out, in colour and in time. Expected colours are computed here by H.273, not by the code under test."""

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from mrbokeh.video.clip import probe, read_display_frames, read_frames
from mrbokeh.video.color import code_from_linear, decode_table, encode_table, linear_from_code, rec709_from_primaries
from mrbokeh.video.writer import VideoWriter
from tests.support.refusals import refused
from tests.support.video_files import encoded, filmed

LUMA = {"709": (0.2126, 0.0722), "601": (0.299, 0.114)}
H273 = {"709": 1, "601": 6, "untagged": 2}


def bars(width_px: int = 320, height_px: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """(code values of 27 colour bars and a grey ramp, mask of the pixels away from their edges)."""
    codes, inner = np.zeros((height_px, width_px, 3), np.float32), np.zeros((height_px, width_px), bool)
    for i, color in enumerate((r, g, b) for r in (0, 0.75, 1) for g in (0, 0.5, 1) for b in (0, 0.25, 1)):
        y, x = divmod(i, 5)
        codes[y * 32 : y * 32 + 32, x * 64 : x * 64 + 64] = color
        inner[y * 32 + 8 : y * 32 + 24, x * 64 + 8 : x * 64 + 56] = True
    codes[192:] = np.linspace(0, 1, width_px)[None, :, None]
    inner[200:, 4:-4] = True
    return codes, inner


def write_yuv444(path: Path, planes: Sequence[np.ndarray], matrix: int = 2, code_range: int = 0, trc: int = 2, primaries: int = 2) -> None:
    """One lossless frame of 8-bit luma and chroma with the tags given."""
    frame = av.VideoFrame.from_ndarray(np.stack(planes), "yuv444p")
    encoded(path, "ffv1", "yuv444p", frame, colorspace=matrix, color_range=code_range, color_trc=trc, color_primaries=primaries)


def rgb_by_h273(planes: Sequence[np.ndarray], matrix: str, *, full: bool) -> np.ndarray:
    """H.273, 8.3: code values of red, green and blue from 8-bit luma and chroma."""
    y, cb, cr = (plane.astype(np.float64) for plane in planes)
    luma = y / 255 if full else (y - 16) / 219
    blue, red = ((cb - 128) / (255 if full else 224), (cr - 128) / (255 if full else 224))
    kr, kb = LUMA[matrix]
    r, b = luma + 2 * (1 - kr) * red, luma + 2 * (1 - kb) * blue
    return np.stack([r, (luma - kr * r - kb * b) / (1 - kr - kb), b], axis=-1)


@pytest.mark.parametrize(
    ("encoding", "suffix", "mean_error", "largest_error"),
    [
        # 8 bit: a luma step is 1/219 and rounding errs by a quarter of it in the mean; 10 bit has a quarter of the steps' size.
        ("h264", ".mp4", 0.002, 0.008),
        ("h264-10bit", ".mp4", 0.001, 0.004),
        ("h265-10bit", ".mp4", 0.001, 0.004),
        ("h265-10bit", ".mkv", 0.001, 0.004),
        ("dnxhr-hqx", ".mov", 0.0005, 0.002),
        ("dnxhr-hqx", ".mxf", 0.0005, 0.002),
        ("prores4444-alpha", ".mov", 0.0005, 0.002),
        ("prores422", ".mov", 0.0005, 0.002),
        ("prores4444", ".mov", 0.0005, 0.002),
        ("ffv1", ".mkv", 0.6 / 65535, 1.2 / 65535),
        ("ffv1-alpha", ".mkv", 0.6 / 65535, 1.2 / 65535),
    ],
)
def test_colour_bars_survive(tmp_path: Path, encoding: str, suffix: str, mean_error: float, largest_error: float) -> None:
    codes, inner = bars()
    path = filmed(tmp_path / f"bars{suffix}", [linear_from_code(codes, "bt709")] * 3, encoding=encoding)
    frames = list(read_frames(path))
    assert [frame.time_s for frame in frames] == pytest.approx([i / 25 for i in range(3)], abs=1e-9)
    error = (code_from_linear(frames[2].rgb, "bt709") - codes)[inner]
    assert np.abs(error).mean() < mean_error and np.abs(error).max() < largest_error and abs(error.mean()) < mean_error / 3
    tags = probe(path).color
    assert (tags.transfer, tags.primaries) == (1, 1)
    assert (tags.matrix, tags.code_range) == ((0, 2) if encoding.startswith("ffv1") else (1, 1))


def test_players_find_the_tags_that_they_know(tmp_path: Path) -> None:
    """QuickTime plays H.265 in MP4 and MOV as hvc1 only; ffprobe's names of the others."""
    tags = {"h265-10bit": "hvc1", "h264": "avc1", "prores4444-alpha": "ap4h", "prores422": "apch", "dnxhr-hqx": "AVdh"}
    for encoding, tag in tags.items():
        path = filmed(tmp_path / f"{encoding}.mov", [np.full((256, 320, 3), 0.18, np.float32)], encoding=encoding)
        with av.open(str(path)) as container:
            assert container.streams.video[0].codec_context.codec_tag == tag


def test_alpha_is_stored_beside_straight_colour(tmp_path: Path) -> None:
    """A ramp of coverage over one colour: 10 bit of alpha, and the colour is the same wherever it is seen."""
    alpha = np.linspace(0, 1, 320, dtype=np.float32)[None].repeat(256, 0)
    picture = np.dstack([alpha * light for light in (0.5, 0.3, 0.2)] + [alpha]).astype(np.float32)
    filmed(tmp_path / "ramp.mov", [picture], encoding="prores4444-alpha")
    with av.open(str(tmp_path / "ramp.mov")) as container:
        stored = next(container.decode(video=0))
    assert stored.format.name == "yuva444p12le"
    plane = stored.planes[3]
    found = np.frombuffer(plane, "<u2").reshape(256, plane.line_size // 2)[:, :320] / 4095
    # Half a step of 10 bit, in which it is written, and a step of the 12 bit in which FFmpeg gives it back.
    np.testing.assert_allclose(found, alpha, atol=0.5 / 1023 + 1 / 4095)
    rgb = next(read_frames(tmp_path / "ramp.mov")).rgb
    np.testing.assert_allclose(rgb[:, 8:], np.broadcast_to(np.float32([0.5, 0.3, 0.2]), (256, 312, 3)), atol=0.004)


@pytest.mark.parametrize(
    ("size", "tag", "range_tag", "matrix", "full"),
    [
        ((1280, 64), "untagged", 0, "709", False), ((64, 578), "untagged", 0, "709", False), ((64, 576), "untagged", 0, "601", False),
        ((1280, 64), "601", 1, "601", False), ((64, 576), "709", 1, "709", False), ((1280, 64), "709", 2, "709", True),
        ((64, 576), "601", 2, "601", True),
    ],
)  # fmt: skip
def test_tags_decide_and_missing_tags_follow_the_size(
    tmp_path: Path, size: tuple[int, int], tag: str, range_tag: int, matrix: str, full: bool
) -> None:
    """Strips of video: either side makes it HD."""
    rng = np.random.default_rng(1)
    planes = [rng.integers(low, high, (size[1], size[0]), dtype=np.uint8) for low, high in ((16, 236), (100, 156), (100, 156))]
    path = tmp_path / "clip.mkv"
    write_yuv444(path, planes, matrix=H273[tag], code_range=range_tag)
    frame = next(read_frames(path))
    expected = linear_from_code(rgb_by_h273(planes, matrix, full=full), "bt709")
    # The table interpolates to about 1e-6; FFmpeg's own conversion would be off by 0.002 in the mean.
    np.testing.assert_allclose(frame.rgb, expected, atol=1e-5)
    shown = next(read_display_frames(path, *size)).bgr[..., ::-1]
    np.testing.assert_allclose(shown, np.clip(rgb_by_h273(planes, matrix, full=full) * 255, 0, 255), atol=0.5 + 1e-3)


@pytest.mark.parametrize(
    "pixel_format", ["gray", "gray10le", "yuv420p", "yuv422p10le", "yuv444p12le", "yuva444p10le", "nv12", "bgr0", "gbrp10le"]
)
def test_every_kind_of_storage_means_the_same_grey(tmp_path: Path, pixel_format: str) -> None:
    """Luma 126 of 8-bit limited range is (126 - 16) / 219; RGB and grey (full range) store the nearest code to it."""
    grey, frame = (126 - 16) / 219, av.VideoFrame(64, 32, pixel_format)
    bits, full = frame.format.components[0].bits, frame.format.is_rgb or pixel_format.startswith("gray")
    luma = round(grey * (2**bits - 1)) if full else 126 << (bits - 8)
    for i, plane in enumerate(frame.planes):
        code = luma if i == 0 or frame.format.is_rgb else 128 << (bits - 8)
        plane.update(code.to_bytes(1 if bits == 8 else 2, "little") * (plane.buffer_size // (1 if bits == 8 else 2)))
    path = encoded(tmp_path / "grey.nut", "rawvideo", pixel_format, frame, color_range=2 if full else 1)
    error = code_from_linear(next(read_frames(path)).rgb, "bt709") - grey
    assert np.abs(error).max() < 0.5 / (2**bits - 1) + 1e-5
    for width_px in (64, 32):
        shown = next(read_display_frames(path, width_px, width_px // 2)).bgr
        np.testing.assert_allclose(shown, grey * 255, atol=1.0)


def test_display_p3_becomes_rec709() -> None:
    """Red of Display P3 in linear sRGB, as colour.science and the CSS Color 4 specification have it."""
    np.testing.assert_allclose(rec709_from_primaries(12) @ [1, 0, 0], [1.2249, -0.0421, -0.0196], atol=2e-4)
    for primaries in (5, 6, 9, 12):
        np.testing.assert_allclose(rec709_from_primaries(primaries).sum(axis=1), 1.0, atol=1e-9)


def test_transfer_curves() -> None:
    """Points of BT.709-6: V = 4.5 L below 0.018, and 0.18 gives 1.099 * 0.18**0.45 - 0.099 = 0.409008, in its three digits."""
    assert code_from_linear(np.array([0.01, 0.18, 1.0]), "bt709") == pytest.approx([0.045, 0.409008, 1.0], abs=2e-4)
    codes = np.linspace(-0.05, 1.2, 1001)
    for transfer in ("bt709", "srgb", "linear", "gamma22"):
        np.testing.assert_allclose(code_from_linear(linear_from_code(codes, transfer), transfer), codes, atol=2e-6)
    assert decode_table("bt709")[0] == encode_table("bt709")[0] == 0


@pytest.mark.parametrize(("encoding", "suffix", "largest_px"), [("prores422", ".mov", 0.02), ("h264-10bit", ".mp4", 0.1)])
@pytest.mark.parametrize("vertical", [False, True])
def test_chroma_does_not_wander(tmp_path: Path, encoding: str, suffix: str, largest_px: float, vertical: bool) -> None:
    """Chroma read half a pixel beside where it was written shows as half a pixel of a slope, with the slope's sign (rounding has none)."""
    ramp, shifts_px = (np.arange(64) + 0.5) / 64, []
    for sign in (1, -1):
        codes = np.stack([0.5 + 0.2 * sign * (2 * ramp - 1), np.full_like(ramp, 0.4), 0.5 - 0.2 * sign * (2 * ramp - 1)], -1)
        codes = codes[None].repeat(64, axis=0).astype(np.float32)
        codes = codes.transpose(1, 0, 2) if vertical else codes
        path = filmed(tmp_path / f"ramp{suffix}", [linear_from_code(codes, "bt709")], encoding=encoding)
        error = (code_from_linear(next(read_frames(path)).rgb, "bt709") - codes)[8:-8, 8:-8]
        shifts_px.append(sign * (error[..., 0] - error[..., 2]).mean() / 2 * 64 / 0.4)
    assert abs(np.mean(shifts_px)) < largest_px


def test_real_clips_keep_their_frames_and_times(tmp_path: Path, shared_data: Path) -> None:
    """The iPhone clip has a variable frame rate: 71 steps of 1/30 s, 2 slightly longer, 7 twice as long (81 frames)."""
    for name, count in (("ducks_720p.mp4", 109), ("iphone_xr_chart.mov", 81)):
        with av.open(str(shared_data / "video" / name)) as container:
            times_s = sorted(float(packet.pts * packet.time_base) for packet in container.demux(video=0) if packet.pts is not None)
        info = probe(shared_data / "video" / name)
        assert len(times_s) == info.frame_count == count
        for suffix, tolerance_s in ((".mov", 1e-9), (".mp4", 1e-9), (".mkv", 0.0005)):
            path = tmp_path / f"times{suffix}"
            with VideoWriter(path, 64, 48, info.frame_rate, info.time_base) as writer:
                for i, time_s in enumerate(times_s):
                    writer.write(np.full((48, 64, 3), i / 200, np.float32), time_s)
            frames = list(read_frames(path))
            np.testing.assert_allclose([frame.time_s for frame in frames], times_s, atol=tolerance_s)
            # Each picture still sits at its own time: they were counted in grey.
            np.testing.assert_allclose([frame.rgb.mean() for frame in frames], np.arange(count) / 200, atol=0.004)


def test_a_real_clip_survives(tmp_path: Path, shared_data: Path) -> None:
    source = shared_data / "video" / "ducks_720p.mp4"
    info, path, taken = probe(source), tmp_path / "ducks.mov", list(read_frames(source, 30, 32))
    with VideoWriter(path, info.width_px, info.height_px, info.frame_rate, info.time_base, audio_from=source) as writer:
        for frame in taken:
            writer.write(frame.rgb, frame.time_s)
    assert writer.audio_note == "audio copied (aac)"
    for before, after in zip(taken, read_frames(path), strict=True):
        assert after.time_s == pytest.approx(before.time_s, abs=1e-9)
        error = np.abs(code_from_linear(after.rgb, "bt709") - code_from_linear(before.rgb, "bt709"))
        # ProRes is lossy; it stays below one 8-bit step (0.0039) in the mean.
        assert error.mean() < 0.002


def test_iphone_is_full_range_display_p3(shared_data: Path) -> None:
    """Its tags: BT.601 matrix, full range, BT.709 transfer, Display P3. OpenCV's own decoder must see the same grey."""
    path = shared_data / "video" / "iphone_xr_chart.mov"
    info = probe(path)
    assert (info.color.matrix, info.color.code_range, info.color.transfer, info.color.primaries) == (6, 2, 1, 12)
    assert (info.width_px, info.height_px, info.rotation_deg) == (1440, 1080, 0)
    frame = next(read_frames(path))
    shown = next(read_display_frames(path, 1440, 1080)).bgr[..., ::-1] / 255.0
    # Linear Rec.709 taken back to P3 codes is what the file stores: of one pixel in nine.
    p3 = frame.rgb[1::3, 1::3] @ np.linalg.inv(rec709_from_primaries(12)).T
    np.testing.assert_allclose(np.clip(code_from_linear(p3, "bt709"), 0, 1), shown[1::3, 1::3], atol=0.5 / 255 + 1e-4)


def test_audio_is_copied_bit_for_bit_where_the_container_holds_it(tmp_path: Path, shared_data: Path) -> None:
    picture = np.zeros((48, 64, 3), np.float32)

    def copied(source: Path, target: Path, start_s: float) -> tuple[str, list[bytes], list[float]]:
        with VideoWriter(target, 64, 48, Fraction(30), audio_from=source, audio_start_s=start_s) as writer:
            for i in range(30):
                writer.write(picture, i / 30)
        with av.open(str(target)) as container:
            packets = [p for p in container.demux(audio=0) if p.size] if container.streams.audio else []
            return writer.audio_note, [bytes(p) for p in packets], [float(p.pts * p.time_base) for p in packets]

    ducks, iphone = (shared_data / "video" / name for name in ("ducks_720p.mp4", "iphone_xr_chart.mov"))
    with av.open(str(ducks)) as container:
        stored = {bytes(p): float(p.pts * p.time_base) for p in container.demux(audio=0) if p.size}
    note, packets, times_s = copied(ducks, tmp_path / "sound.mp4", 1.0)
    assert note == "audio copied (aac)"
    # One second of AAC at 44100 Hz in packets of 1024 samples is 43 packets.
    assert len(packets) == pytest.approx(43, abs=2)
    assert times_s == pytest.approx([stored[packet] - 1.0 for packet in packets], abs=1e-4)
    assert copied(iphone, tmp_path / "sound.mov", 0.0)[0] == "audio copied (pcm_s16le)"
    assert "encoded anew, for .mp4 does not hold pcm_s16le" in copied(iphone, tmp_path / "anew.mp4", 0.0)[0]


@pytest.mark.parametrize("turn_deg", [90, 180, -90])
def test_a_turned_clip_is_read_upright(tmp_path: Path, turn_deg: int) -> None:
    """OpenCV turns such clips by its own FFmpeg: both must show the same picture."""
    path = tmp_path / "turned.mp4"
    _write_turned(path, np.kron(np.random.default_rng(2).random((3, 4, 3)), np.ones((32, 32, 1))).astype(np.float32), turn_deg)
    frame, capture = next(read_frames(path)), cv2.VideoCapture(str(path))
    there, bgr = capture.read()
    capture.release()
    assert there and frame.rgb.shape == bgr.shape and (probe(path).height_px, probe(path).width_px) == bgr.shape[:2]
    np.testing.assert_allclose(code_from_linear(frame.rgb, "bt709")[16::32, 16::32], bgr[16::32, 16::32, ::-1] / 255, atol=0.02)
    shown = next(read_display_frames(path, bgr.shape[1], bgr.shape[0])).bgr
    np.testing.assert_allclose(shown[16::32, 16::32] / 255, bgr[16::32, 16::32] / 255, atol=0.02)


def _write_turned(path: Path, codes: np.ndarray, turn_deg: int) -> None:
    frame = av.VideoFrame.from_ndarray(np.rint(codes * 255).astype(np.uint8), "rgb24")
    frame = frame.reformat(format="yuv420p", dst_colorspace=1, src_color_range=2, dst_color_range=1)
    encoded(path, "libx264", "yuv420p", frame, turn_deg=turn_deg, options={"crf": "1"}, colorspace=1, color_range=1)


def test_what_cannot_be_shown_rightly_is_refused(tmp_path: Path) -> None:
    grey, odd = [np.full((64, 64), 128, np.uint8)] * 3, tmp_path / "odd.mkv"
    refused_tags = {("trc", 16): "HDR video", ("trc", 18): "HDR video", ("matrix", 10): "colour matrix", ("primaries", 22): "primaries"}
    for (tag, value), words in refused_tags.items():
        write_yuv444(odd, grey, **{tag: value})
        refused(words, next, read_frames(odd))
    (tmp_path / "text.mp4").write_text("no video")
    encoded(tmp_path / "wide.mp4", "libx264", "yuv420p", av.VideoFrame(64, 48, "yuv420p"), options={"x264-params": "sar=4/3"})
    greys = [av.VideoFrame.from_ndarray(np.full((96, 64), 40 * i + 16, np.uint8), "yuv420p") for i in range(3)]
    encoded(tmp_path / "fields.mpg", "mpeg2video", "yuv420p", *greys, options={"flags": "+ildct+ilme"})
    _write_turned(tmp_path / "crooked.mp4", np.zeros((64, 64, 3), np.float32), 30)
    told = {"text.mp4": "cannot be read as a video", "absent.mp4": "no such file", "wide.mp4": "not square", "fields.mpg": "interlaced"}
    for name, words in (told | {"crooked.mp4": "quarter turns"}).items():
        refused(words, probe, tmp_path / name)


def write_all(path: Path, pictures: Iterable[tuple[np.ndarray, float]]) -> None:
    with VideoWriter(path, 64, 48) as writer:
        for rgb, time_s in pictures:
            writer.write(rgb, time_s)


def test_a_broken_off_video_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> Iterator[tuple[np.ndarray, float]]:
        yield np.zeros((48, 64, 3), np.float32), 0.0
        raise KeyboardInterrupt

    path = tmp_path / "clip.mov"
    path.write_bytes(b"an earlier result")
    with pytest.raises(KeyboardInterrupt):
        write_all(path, interrupted())
    assert [file.name for file in tmp_path.iterdir()] == ["clip.mov"] and path.read_bytes() == b"an earlier result"


def test_mistakes_in_writing_are_explained(tmp_path: Path) -> None:
    for name, width_px, more, sentence in (
        ("clip.avi", 64, {}, r"expected \.mp4, \.mov, \.mkv"), ("clip.mp4", 63, {}, "halved chroma"),
        ("clip.mp4", 64, {"encoding": "prores4444"}, r"prores4444 is written to \.mov"),
    ):  # fmt: skip
        refused(sentence, VideoWriter, tmp_path / name, width_px, 48, **more)
    picture = np.zeros((48, 64, 3), np.float32)
    for pictures, sentence in (
        ([], "got none"), ([(picture, 1.0), (picture, 1.0)], "growing times"), ([(picture[1:], 0.0)], "expected pictures of 64x48"),
    ):  # fmt: skip
        refused(sentence, write_all, tmp_path / "clip.mp4", pictures)
    assert list(tmp_path.iterdir()) == []
