"""The alpha of a clip, carried through `mrbokeh video`: numbered pictures and real codecs, with coverage that is known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

import mrbokeh.video.image_sequence as image_sequence
import mrbokeh.video.picture_source as video_source
from mrbokeh.images.alpha_io import write_finished
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image, read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.shots.executors import ProcessExecutor, SerialExecutor
from mrbokeh.shots.render_shot import SequenceTarget, VideoTarget, render_shot
from mrbokeh.shots.shot import Shot
from mrbokeh.video.clip import read_frames
from mrbokeh.video.color import color_of
from mrbokeh.video.frames import has_alpha, linear_rgb, stored_alpha
from mrbokeh.video.picture_source import PictureSource, open_source
from tests.support.shot_makers import Brighter
from tests.support.video_files import encoded, filmed, turned_clip
from tests.support.video_files import video as run

WIDTH, HEIGHT, COUNT = 96, 64, 5
LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=2.0, sensor_width_mm=6.0)
SQUARE = np.s_[20:40, 30:60]
LIGHT, COVER = np.float32([0.6, 0.3, 0.15]), 0.75
# Half a step where alpha is written in 10 bit, and one of the 12 bit in which FFmpeg gives it back.
PRORES_ALPHA = 0.5 / 1023 + 1 / 4095
HALF = 2**-11
CLIPS = {"exr": "in.%d.exr", "png": "in.%d.png", "tif": "in.%d.tif", "prores": "in.mov", "ffv1": "in.mkv"}


def picture(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied light (H, W, 3) and alpha (H, W) of a frame: a ramp of coverage that wanders, nothing in the upper rows, all below."""
    ramp = np.linspace(0.05, 0.95, WIDTH, dtype=np.float32)
    alpha = np.repeat(np.roll(ramp, 7 * index)[None], HEIGHT, axis=0)
    alpha[:8], alpha[-8:] = 0.0, 1.0
    straight = np.linspace(0.1, 0.8, HEIGHT, dtype=np.float32)[:, None, None] * np.float32([1.0, 0.7, 0.4])
    return (straight * alpha[..., None]).astype(np.float32), alpha


def clip_of(folder: Path, kind: str) -> tuple[Path, list[str]]:
    """The clip's name, and what the command line needs beside it."""
    path = folder / CLIPS[kind]
    if kind in ("prores", "ffv1"):
        encoding = {"prores": "prores4444-alpha", "ffv1": "ffv1-alpha"}[kind]
        return filmed(path, (np.dstack(picture(i)).astype(np.float32) for i in range(COUNT)), encoding=encoding), []
    for i in range(COUNT):
        write_finished(Path(str(path) % i), *picture(i))
    return path, ["--rate", "25"]


@pytest.fixture
def settings(tmp_path: Path) -> list[str]:
    """A half-transparent square in focus: its blur is one pixel, itself."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[SQUARE] = COVER
    depth_m = np.where(alpha > 0, np.float32(2.0), np.float32(np.inf))
    write_layer(tmp_path / "layer.exr", Layer(alpha[..., None] * LIGHT, alpha, depth_m), half=False)
    write_lens(tmp_path / "lens.json", LENS)
    return ["--layer", str(tmp_path / "layer.exr"), "--lens", str(tmp_path / "lens.json"), "--workers", "1", "--segment", "0.08"]


def frames_of(source: PictureSource) -> tuple[np.ndarray, np.ndarray]:
    """(frames, H, W, 3) and (frames, H, W)"""
    frames = list(source.frames(0, len(source.times_s)))
    assert all(frame.alpha is not None for frame in frames)
    return np.stack([frame.rgb for frame in frames]), np.stack([frame.alpha for frame in frames if frame.alpha is not None])


# 16-bit sRGB: half a step of 1/65535 where its slope is 2.3; ProRes is lossy: a luma step of 10 bit is 1/876, whose slope is 2.
READ = dict.fromkeys(("png", "tif", "ffv1"), (0.6 / 65535, 2 / 65535)) | {"exr": (HALF, HALF), "prores": (PRORES_ALPHA, 0.01)}


@pytest.mark.parametrize("kind", READ)
def test_sources_give_premultiplied_light_and_alpha(tmp_path: Path, kind: str) -> None:
    clip, more = clip_of(tmp_path, kind)
    source = open_source(clip, *more[1:])
    assert source.info.has_alpha
    rgb, alpha = frames_of(source)
    for found, index, error in ((alpha, 1, READ[kind][0]), (rgb, 0, READ[kind][1])):
        np.testing.assert_allclose(found, [picture(i)[index] for i in range(COUNT)], atol=error)
    (later,) = source.frames(3, 4)
    np.testing.assert_array_equal(later.alpha, alpha[3])


@pytest.mark.parametrize(
    ("kind", "out", "alpha_error", "light_error"),
    [
        ("exr", "out.%d.exr", HALF, HALF), ("png", "out.%d.png", 1.2 / 65535, 4 / 65535),
        ("tif", "out.%d.tif", 1.2 / 65535, 4 / 65535), ("png", "out.%d.exr", HALF, HALF), ("exr", "out.%d.png", HALF, HALF),
        ("ffv1", "out.mkv", 1.2 / 65535, 4 / 65535), ("prores", "out.mov", 2 * PRORES_ALPHA, 0.02),
        ("prores", "out.%d.exr", PRORES_ALPHA + HALF, 0.01),
    ],
)  # fmt: skip
def test_an_object_before_a_half_transparent_clip(
    settings: list[str], tmp_path: Path, kind: str, out: str, alpha_error: float, light_error: float
) -> None:
    """Coverage a before b is a + (1 - a) b, and so is light; where the object is not, both are the clip's, in several segments."""
    clip, more = clip_of(tmp_path, kind)
    assert "warning" not in run(clip, *more, *settings, "--out", tmp_path / out)
    before_rgb, before = frames_of(open_source(clip, *more[1:]))
    rgb, alpha = frames_of(open_source(tmp_path / out, *(["25"] if "%d" in out else [])))
    assert len(alpha) == COUNT
    truth_rgb, truth = np.stack([picture(i)[0] for i in range(COUNT)]), np.stack([picture(i)[1] for i in range(COUNT)])
    inside = (slice(None), *SQUARE)
    np.testing.assert_allclose(alpha[inside], COVER + (1 - COVER) * truth[inside], atol=alpha_error)
    np.testing.assert_allclose(rgb[inside], COVER * LIGHT + (1 - COVER) * truth_rgb[inside], atol=light_error)
    far = np.ones((HEIGHT, WIDTH), bool)
    far[SQUARE] = False
    if CLIPS[kind].replace("in", "out") == out:
        np.testing.assert_array_equal(alpha[:, far], before[:, far])
    if CLIPS[kind].replace("in", "out") == out and kind != "prores":
        np.testing.assert_array_equal(rgb[:, far], before_rgb[:, far])
    assert not alpha[:, :8].any() and (alpha[:, -8:] == 1.0).all()


def test_a_frame_that_is_opaque_has_alpha_like_the_others(settings: list[str], tmp_path: Path) -> None:
    for i, alpha in enumerate((np.full((HEIGHT, WIDTH), 0.5, np.float32), np.ones((HEIGHT, WIDTH), np.float32))):
        write_finished(tmp_path / f"in.{i}.exr", 0.25 * np.repeat(alpha[..., None], 3, axis=2), alpha)
    run(tmp_path / "in.%d.exr", "--rate", "25", *settings, "--out", tmp_path / "out.%d.exr")
    for i, expected in enumerate((0.5, 1.0)):
        (part,) = read_exr(tmp_path / f"out.{i}.exr")
        assert (part.channels["A"][:8] == expected).all()


@pytest.mark.parametrize("kind", ["exr", "ffv1"])
@pytest.mark.slow
def test_workers_that_die_lose_no_alpha(tmp_path: Path, kind: str) -> None:
    """A worker is killed amid the second segment, and its segment is made again; then the whole run is, and goes on from its parts."""
    clip, more = clip_of(tmp_path, kind)
    source, killing = open_source(clip, *more[1:]), tmp_path / "kill"
    targets = [
        SequenceTarget(tmp_path / f"{name}.%d.exr") if kind == "exr" else VideoTarget(tmp_path / f"{name}.mkv", "ffv1-alpha")
        for name in "ab"
    ]
    render_shot(Shot(source, Brighter(), targets[0], range(COUNT), 2), SerialExecutor())
    killing.touch()
    shot = Shot(source, Brighter(killing=killing), targets[1], range(COUNT), 2)
    with pytest.raises(KeyboardInterrupt):
        render_shot(shot, ProcessExecutor(1), progress=_interrupting(3))
    assert shot.was_begun and not killing.exists()
    render_shot(shot, SerialExecutor())
    first, second = (frames_of(open_source(target.path, *more[1:])) for target in targets)
    np.testing.assert_array_equal(first[1], second[1])
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_allclose(second[1], [picture(i)[1] for i in range(COUNT)], atol=HALF)


def _interrupting(after: int) -> Callable[[int], None]:
    told: list[int] = []

    def progress(count: int) -> None:
        told.append(count)
        if sum(told) >= after:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize(
    ("out", "more", "told"),
    [
        ("out.mp4", (), "h264 cannot hold it (write .mov, .mkv or frames.%04d.exr)"),
        ("out.mkv", ("--encoding", "h265-10bit"), "h265-10bit cannot hold it (write --encoding ffv1-alpha)"),
        ("out.mov", ("--encoding", "prores4444"), "prores4444 cannot hold it (write --encoding prores4444-alpha)"),
        ("out.%d.jpg", (), ".jpg cannot hold it (write .exr, .png or .tif)"),
    ],
)
def test_what_cannot_hold_alpha_is_told_and_black(settings: list[str], tmp_path: Path, out: str, more: tuple[str, ...], told: str) -> None:
    clip, _ = clip_of(tmp_path, "prores")
    output = run(clip, *settings, *more, "--frames", "0-1", "--out", tmp_path / out)
    warning = f"warning: {clip} has alpha, but {told}: what it does not cover is black in {out}"
    assert " ".join(output.split()).count(warning) == 1 and output.index("warning") < output.index("wrote")
    rgb = read_image(tmp_path / "out.0.jpg") if "%d" in out else next(read_frames(tmp_path / out)).rgb
    assert np.abs(rgb[:6]).max() < 0.01
    # 8 bit and halved chroma: a few codes of 1/219.
    assert np.abs(rgb[10:18, 8:-8] - picture(0)[0][10:18, 8:-8]).mean() < 0.01


def test_alpha_that_is_not_decoded_is_told(settings: list[str], tmp_path: Path) -> None:
    """VP9 keeps it in a second stream inside its packets."""
    frame = av.VideoFrame(WIDTH, HEIGHT, "yuva420p")
    for plane in frame.planes:
        np.frombuffer(plane, np.uint8)[:] = 128  # type: ignore[call-overload]
    encoded(tmp_path / "in.webm", "libvpx-vp9", "yuva420p", frame)
    output = run(tmp_path / "in.webm", *settings, "--out", tmp_path / "out.mkv")
    assert f"warning: {tmp_path / 'in.webm'} keeps its alpha apart (VP8, VP9), where it is not read: it is taken as opaque" in output
    assert not open_source(tmp_path / "out.mkv").info.has_alpha


@pytest.mark.parametrize(
    ("lens", "more"),
    [
        (LENS, ["--mode", "front"]), (replace(LENS, petzval_radius_mm=200.0), []), (LENS, ["--renderer", "low-rank"]),
        (LENS, ["--light-wrap", "0.5"]),
    ],
)  # fmt: skip
def test_blurred_coverage_is_put_before_the_clips(settings: list[str], tmp_path: Path, lens: Lens, more: list[str]) -> None:
    """In the box and in the whole frame, with a look and without: out of the blurred layer, which --virtual-only writes."""
    clip, _ = clip_of(tmp_path, "ffv1")
    write_lens(tmp_path / "lens.json", replace(lens, focus_distance_m=1.0))
    run(clip, *settings, *more, "--out", tmp_path / "out.mkv")
    run(clip, *settings, *more, "--virtual-only", "--out", tmp_path / "virtual.%d.exr")
    (before_rgb, before), (rgb, alpha) = (frames_of(open_source(tmp_path / name)) for name in ("in.mkv", "out.mkv"))
    for i in range(COUNT):
        virtual = read_layer(tmp_path / f"virtual.{i}.exr")
        assert 0.1 < virtual.alpha.max() < 0.76 and (virtual.alpha[41, 25:65] > 0.01).any()
        np.testing.assert_allclose(alpha[i], virtual.alpha + (1 - virtual.alpha) * before[i], atol=HALF)
        if "--light-wrap" not in more:
            np.testing.assert_allclose(rgb[i], virtual.rgb + (1 - virtual.alpha[..., None]) * before_rgb[i], atol=HALF)


def test_where_alpha_does_not_matter_nothing_is_told(settings: list[str], tmp_path: Path) -> None:
    clip, more = clip_of(tmp_path, "png")
    assert "warning" not in run(clip, *more, *settings, "--virtual-only", "--out", tmp_path / "virtual.mkv")
    opaque = filmed(tmp_path / "opaque.mkv", [np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)])
    assert "warning" not in run(opaque, *settings, "--out", tmp_path / "opaque.mp4")


@pytest.mark.parametrize("suffix", ["png", "exr", "mkv"])
def test_alpha_of_opaque_clips_is_never_read(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    grey = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)
    if suffix == "mkv":
        source = open_source(filmed(tmp_path / "in.mkv", [grey]))
    else:
        write_finished(tmp_path / f"in.0.{suffix}", grey)
        source = open_source(tmp_path / f"in.%d.{suffix}", "25")
    for module, name in ((image_sequence, "read_alpha"), (video_source, "upright_alpha")):
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("alpha was read"))
    (frame,) = source.frames(0, 1)
    assert frame.alpha is None and not source.info.has_alpha


def test_alpha_turns_with_the_clip(tmp_path: Path) -> None:
    clip, _ = clip_of(tmp_path, "prores")
    level = frames_of(open_source(turned_clip(clip, tmp_path / "0.mov", 0)))
    for turn_deg in (90, 180, 270):
        turned = frames_of(open_source(turned_clip(clip, tmp_path / f"{turn_deg}.mov", turn_deg)))
        for found, before in zip(turned, level, strict=True):
            np.testing.assert_array_equal(found, np.rot90(before, turn_deg // 90, axes=(1, 2)))


@pytest.mark.parametrize(("codec", "pixels", "bits"), [("png", "rgba", 8), ("png", "rgba64be", 16), ("qtrle", "argb", 8)])
def test_other_codecs_of_editors_keep_alpha_too(tmp_path: Path, codec: str, pixels: str, bits: int) -> None:
    """PNG and Animation in QuickTime, lossless; colour is white throughout, so that light is alpha."""
    largest = (1 << bits) - 1
    codes = np.round(picture(0)[1] * largest).astype(np.uint16)
    frame = av.VideoFrame(WIDTH, HEIGHT, "gbrap" if bits == 8 else "gbrap16le")
    for plane, values in zip(frame.planes, (np.full_like(codes, largest),) * 3 + (codes,), strict=True):
        stored = np.frombuffer(plane, np.uint8 if bits == 8 else "<u2").reshape(HEIGHT, -1)  # type: ignore[call-overload]
        stored[:, :WIDTH] = values
    encoded(tmp_path / "in.mov", codec, pixels, frame.reformat(format=pixels))
    rgb, alpha = frames_of(open_source(tmp_path / "in.mov"))
    np.testing.assert_allclose(alpha[0], codes / largest, atol=1e-7)
    np.testing.assert_allclose(rgb[0], np.repeat(alpha[0][..., None], 3, axis=2), atol=1e-6)


@pytest.mark.parametrize("pixels", ["yuva420p", "yuva422p10le", "yuva444p12le", "gbrap10le", "yuva444p16be", "rgba64le", "bgra"])
def test_alpha_of_every_format_is_its_own_number(pixels: str) -> None:
    """Every code of a wandering ramp, in odd sizes, whose rows are padded; FFmpeg does not touch them."""
    stored = av.VideoFrame(13, 7, pixels)
    alpha = stored.format.components[3]
    codes = np.round(np.linspace(0, (1 << alpha.bits) - 1, 13 * 7)).reshape(7, 13)
    number = ">u2" if pixels.endswith("be") else "<u2" if alpha.bits > 8 else "u1"
    plane = np.frombuffer(stored.planes[alpha.plane], number).reshape(7, -1)  # type: ignore[call-overload]
    target = plane[:, 3 : 4 * 13 : 4] if alpha.plane == 0 else plane[:, :13]
    target[:] = codes
    assert has_alpha(stored) and not has_alpha(av.VideoFrame(13, 7, "gbrp"))
    np.testing.assert_array_equal(stored_alpha(stored), (codes / np.float32((1 << alpha.bits) - 1)).astype(np.float32))


def test_grey_beside_alpha_is_grey() -> None:
    both, grey = av.VideoFrame(16, 4, "ya8"), av.VideoFrame(16, 4, "gray")
    luma = np.arange(16, 16 + 3 * 64, 3, np.uint8).reshape(4, 16)
    for frame, step in ((both, 2), (grey, 1)):
        np.frombuffer(frame.planes[0], np.uint8).reshape(4, -1)[:, : 16 * step : step] = luma  # type: ignore[call-overload]
        frame.colorspace, frame.color_range = 1, 1
    np.testing.assert_array_equal(linear_rgb(both, color_of(both, "both")), linear_rgb(grey, color_of(grey, "grey")))


@pytest.mark.parametrize("out", ["out.mkv", "out.%d.exr", "out.%d.png"])
def test_curves_of_named_spaces_are_for_straight_colour(settings: list[str], tmp_path: Path, out: str) -> None:
    """Written in a camera's curve and read by it again, it is the same premultiplied light and alpha."""
    pytest.importorskip("PyOpenColorIO")
    clip, more = clip_of(tmp_path, "png")
    run(clip, *more, *settings, "--out", tmp_path / "plain.mkv")
    run(clip, *more, *settings, "--output-space", "ARRI LogC4", "--out", tmp_path / out)
    rgb, alpha = frames_of(open_source(tmp_path / out, *(["25"] if "%d" in out else [None]), NamedSpace("ARRI LogC4")))
    plain_rgb, plain = frames_of(open_source(tmp_path / "plain.mkv"))
    np.testing.assert_allclose(alpha, plain, atol=HALF)
    # At 0.8 LogC4 has the code 0.41, and light grows 8.9 times as fast. Half a step of 16 bit is 7e-5 of light, of BT.709 and of alpha 2e-5
    # each. Half rounds colour and alpha by 2^-11 each: (2 * 8.9 * 0.41 + 0.8) * 2^-11 = 4e-3.
    np.testing.assert_allclose(rgb, plain_rgb, atol=4e-3 if out == "out.%d.exr" else 1.1e-4)
