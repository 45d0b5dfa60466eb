"""`mrbokeh video` in colour spaces of OpenColorIO: numbers of the cameras' own documents in, the same numbers out."""

from pathlib import Path

import av
import numpy as np
import pytest

from mrbokeh.images.exr_io import AP1, ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.video.clip import read_frames
from tests.support.refusals import refused
from tests.support.video_files import encoded, filmed
from tests.support.video_files import video as run

pytest.importorskip("PyOpenColorIO")

WIDTH, HEIGHT = 96, 64
# ARRI, LogC4 specification, 2022: 18 % grey is 0.278396 of full code.
LOGC4, GREY = 0.278396, 0.18
# Red of Rec.709 in AP1 (ACES documents, Bradford).
RED_IN_AP1 = (0.6131, 0.0702, 0.0206)


def clip_of_codes(path: Path, code: float, encoding: str | None = None) -> Path:
    return filmed(path, [np.full((HEIGHT, WIDTH, 3), code, np.float32)] * 3, encoding=encoding, as_codes=True)


@pytest.fixture
def settings(tmp_path: Path) -> list[str]:
    """A red square at 2 m, where the lens is focused, in the middle of nothing; half of it covers by half."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[20:40, 30:45], alpha[20:40, 45:60] = 1.0, 0.5
    rgb = alpha[..., None] * np.array([0.5, 0.0, 0.0], np.float32)
    write_layer(tmp_path / "layer.exr", Layer(rgb, alpha, np.where(alpha > 0, np.float32(2.0), np.float32(np.inf))), half=False)
    write_lens(tmp_path / "lens.json", Lens(50.0, 2.0, 2.0, 6.0))
    return ["--layer", str(tmp_path / "layer.exr"), "--lens", str(tmp_path / "lens.json"), "--workers", "1"]


def codes_of(path: Path) -> tuple[np.ndarray, int, int]:
    """(luma or green of the first picture as a share of full code, transfer tag, tag of primaries), by PyAV itself."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        plane = np.frombuffer(frame.planes[0], "<u2").reshape(frame.planes[0].height, -1)[:, : frame.width]
        unit = 2.0 ** (frame.format.components[0].bits - 8)
        codes = plane / 65535 if frame.format.is_rgb else (plane / unit - 16) / 219
        return codes, int(frame.color_trc), int(frame.color_primaries)


@pytest.mark.parametrize(("suffix", "step"), [(".mkv", 1 / 65535), (".mov", 1 / 876)])
def test_a_log_clip_is_read_as_light_and_written_as_log(tmp_path: Path, settings: list[str], suffix: str, step: float) -> None:
    """FFV1 keeps 16 bit, ProRes 10; no tag says what LogC4 is, so there is none."""
    clip, out = clip_of_codes(tmp_path / f"clip{suffix}", LOGC4), tmp_path / f"out{suffix}"
    run(clip, *settings, "--input-space", "ARRI LogC4", "--out", tmp_path / "light.%02d.exr")
    light = read_image(tmp_path / "light.01.exr")
    # At grey a stop is 0.056 of code (the slope of LogC4's formula), so half a step of ProRes, 1 / 876 / 2, is 0.7 % of light.
    np.testing.assert_allclose(light[5], GREY, rtol=0.002 if suffix == ".mkv" else 0.01)
    np.testing.assert_allclose(light[30, 35], [0.5, 0.0, 0.0], atol=1e-3)
    run(clip, *settings, "--input-space", "ARRI LogC4", "--output-space", "ARRI LogC4", "--out", out)
    codes, transfer, primaries = codes_of(out)
    assert (transfer, primaries) == (2, 2)
    np.testing.assert_allclose(codes[5], LOGC4, atol=2 * step)
    run(out, *settings, "--input-space", "ARRI LogC4", "--out", tmp_path / "again.%02d.exr")
    np.testing.assert_allclose(read_image(tmp_path / "again.01.exr")[30, 35], [0.5, 0.0, 0.0], atol=0.001 if suffix == ".mkv" else 0.03)


def test_segments_of_codes_join_and_sequences_of_acescg_come_and_go(tmp_path: Path, settings: list[str]) -> None:
    for i in range(4):
        stored = np.full((HEIGHT, WIDTH, 3), RED_IN_AP1, np.float32)
        write_image(tmp_path / f"in.{i:02d}.exr", stored, half=False)
    options = ["--rate", "25", "--segment", "0.08", "--input-space", "ACEScg"]
    run(tmp_path / "in.%02d.exr", *settings, *options, "--out", tmp_path / "ours.%02d.exr")
    np.testing.assert_allclose(read_image(tmp_path / "ours.03.exr")[5], np.tile([1.0, 0.0, 0.0], (WIDTH, 1)), atol=1e-3)
    run(tmp_path / "in.%02d.exr", *settings, *options, "--output-space", "ACEScg", "--out", tmp_path / "same.%02d.exr")
    same = read_exr(tmp_path / "same.03.exr")[0].stacked("RGB")
    np.testing.assert_allclose(same[5, 5], RED_IN_AP1, atol=5e-4)
    np.testing.assert_allclose(same[30, 35], 0.5 * np.array(RED_IN_AP1), atol=5e-4)
    run(tmp_path / "in.%02d.exr", *settings, *options, "--output-space", "ARRI LogC4", "--out", tmp_path / "out.mkv")
    run(tmp_path / "out.mkv", *settings, "--input-space", "ARRI LogC4", "--out", tmp_path / "back.%02d.exr")
    np.testing.assert_allclose(read_image(tmp_path / "back.03.exr")[5, 5], [1.0, 0.0, 0.0], atol=2e-3)


def test_integers_are_read_without_a_curve(tmp_path: Path, settings: list[str]) -> None:
    write_image(tmp_path / "log.1.png", np.full((HEIGHT, WIDTH, 3), LOGC4, np.float32), "linear")
    words = ["--rate", "25", "--input-space", "ARRI LogC4", "--output-space", "ARRI LogC4"]
    run(tmp_path / "log.%d.png", *settings, *words, "--out", tmp_path / "out.%d.tif")
    np.testing.assert_allclose(read_image(tmp_path / "out.1.tif", "linear")[5], LOGC4, atol=1.5 / 65535)


def test_a_virtual_layer_keeps_its_coverage_through_a_curve(tmp_path: Path, settings: list[str]) -> None:
    """Where it covers by half, straight colour goes through the curve; linear spaces take it as it is."""
    clip = clip_of_codes(tmp_path / "clip.mkv", 0.3)
    words = [*settings, "--input-space", "ARRI LogC4", "--virtual-only"]
    run(clip, *words, "--output-space", "ACEScg", "--out", tmp_path / "cg.%d.exr")
    (part,) = read_exr(tmp_path / "cg.1.exr")
    stored = part.stacked("RGB")
    np.testing.assert_allclose(stored[30, 35], 0.5 * np.array(RED_IN_AP1), atol=5e-4)
    np.testing.assert_allclose(stored[30, 52], 0.25 * np.array(RED_IN_AP1), atol=5e-4)
    np.testing.assert_allclose(part.attributes["chromaticities"], AP1, atol=1e-6)
    layer = read_layer(tmp_path / "cg.1.exr")
    np.testing.assert_allclose(layer.rgb[30, 35], [0.5, 0.0, 0.0], atol=1e-3)
    assert np.isfinite(layer.depth_m[30, 35])
    run(clip, *words, "--output-space", "ACEScct", "--out", tmp_path / "cct.%d.exr")
    curved = read_layer(tmp_path / "cct.1.exr")
    np.testing.assert_allclose(curved.rgb[30, 52], 0.5 * curved.rgb[30, 35], atol=5e-4)
    # ACEScct (S-2016-001): (log2(x) + 9.72) / 17.52 of half of red in AP1.
    np.testing.assert_allclose(curved.rgb[30, 35, 0], (np.log2(0.5 * RED_IN_AP1[0]) + 9.72) / 17.52, atol=1e-3)
    assert (curved.rgb[5] == 0).all()


def test_video_of_high_dynamic_range_is_read_where_its_space_is_named(tmp_path: Path, settings: list[str]) -> None:
    """A clip tagged PQ is refused, unless the user says what its codes are; reference white, 203 cd/m2, is 0.58 of PQ (BT.2408)."""
    clip = tmp_path / "pq.mkv"
    codes = np.full((HEIGHT, WIDTH, 3), round(0.58 * 65535), np.uint16)
    frame = av.VideoFrame.from_ndarray(codes, "rgb48le").reformat(format="gbrp16le")
    encoded(clip, "ffv1", "gbrp16le", frame, color_trc=16, color_primaries=9)
    refused("HDR video", run, clip, *settings, "--out", tmp_path / "no.%d.exr")
    run(clip, *settings, "--input-space", "Rec.2100-PQ - Display", "--out", tmp_path / "out.%d.exr")
    light = read_image(tmp_path / "out.0.exr")[5, 5]
    # OpenColorIO counts display light by 100 cd/m2.
    np.testing.assert_allclose(light, 2.03, rtol=0.01)


def test_what_makes_no_sense_ends_in_a_sentence(tmp_path: Path, settings: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    clip = clip_of_codes(tmp_path / "clip.mkv", 0.3)
    for words, message in (
        ("--input-space ACEScg --out out.mkv", "follow a curve, but ACEScg is linear"),
        ("--output-space ACEScg --out out.mov", "which codes of a video cannot hold"),
        ("--output-space ACEScg --out out.%d.png", "which integers cut off at 1"),
        ("--output-space LogC9 --out out.mov", "has no colour space 'LogC9'"),
        ("--output-space ACEScg --ocio none.ocio --out out.mov", "expected an OpenColorIO configuration"),
    ):
        refused(message, run, clip, *settings, *words.split())
    assert not list(tmp_path.glob("out*"))


def test_without_a_space_nothing_changes(tmp_path: Path, settings: list[str]) -> None:
    """A file written as codes is read as BT.709 where nobody says what it is: 0.3 is ((0.3 + 0.0993) / 1.0993)^(1 / 0.45) of light."""
    clip = clip_of_codes(tmp_path / "clip.mkv", 0.3)
    np.testing.assert_allclose(next(read_frames(clip)).rgb, (0.39929682680944 / 1.09929682680944) ** (1 / 0.45), rtol=1e-3)
    write_exr(tmp_path / "p.1.exr", ExrPart({name: np.full((HEIGHT, WIDTH), 0.25, np.float32) for name in "RGB"}))
    run(tmp_path / "p.%d.exr", "--rate", "25", *settings, "--out", tmp_path / "out.%d.exr")
    np.testing.assert_allclose(read_image(tmp_path / "out.1.exr")[5], 0.25, atol=1e-4)
