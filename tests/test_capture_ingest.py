"""Photographs into focal stacks: order, lens, exposure, damaged files, interruption; and the shipped RAW stack against its truth."""

import json
import math
import os
import shutil
import struct
from dataclasses import replace
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32
from scipy.ndimage import affine_transform, gaussian_filter, uniform_filter
from typer.testing import CliRunner

import capture.stacks.stack_ingest
from capture.cli import app
from capture.commands.ingest import parse_white_balance
from capture.stacks.exposure import ExposureGain, evened_out, low_frequency, measure_gain
from capture.stacks.grouping import Grouping
from capture.stacks.ingest import IngestReport, IngestSettings, ingest
from capture.stacks.slice_files import find_slices
from capture.stacks.stack_ingest import Development
from datasets_scripts.dng_writer import ShotMetadata, write_dng
from datasets_scripts.sensor_model import SensorModel
from mrbokeh.errors import InputError
from mrbokeh.exr_io import read_exr
from mrbokeh.focal_stack import FocalStack, read_focal_stack
from mrbokeh.image_io import read_image, write_image
from mrbokeh.lens import Lens

Picture = Float32[np.ndarray, "height width 3"]
LENS = Lens(35.0, 2.8, 1.0, 23.5)
DISTANCES_M = (1.4, 0.6, 0.8, math.inf, 1.0)
DEMO_STACK = Path(__file__).resolve().parent.parent / "mrbokeh" / "demo_data" / "raw_stack"


def scene_rgb(height: int, width: int, seed: int = 0) -> Picture:
    """Soft blobs of all sizes (a 1/f spectrum, like photographs) in three colours, 0.02 to 0.6, and two lamps above white."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]
    spectrum = 1.0 / np.maximum(np.hypot(fy, fx), 1.0 / width)
    noise = np.stack([np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) * spectrum).real for _ in range(3)], axis=-1)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    rgb = 0.02 + 0.58 * gaussian_filter(noise**2, (1.5, 1.5, 0.0))
    rgb[height // 3 : height // 3 + 6, width // 4 : width // 4 + 6] = 4.0
    rgb[height // 2 : height // 2 + 6, 3 * width // 4 : 3 * width // 4 + 6] = 4.0
    return rgb.astype(np.float32)


def make_raw_photo(path: Path, rgb: Picture, focus_m: float, exposure_time_s: Fraction = Fraction(1, 60), seconds: int = 0) -> Path:
    """A noise-free DNG of a scene; the exposure time acts on the pixels."""
    sensor = SensorModel(full_well_electrons=0.0, read_noise_electrons=0.0)
    mosaic = sensor.linear_mosaic(rgb * np.float32(exposure_time_s * 60))
    taken_at = datetime(2025, 6, 1, 12) + timedelta(seconds=seconds)
    shot = ShotMetadata(LENS.focused_at(min(focus_m, 10.0)), exposure_time_s=exposure_time_s, taken_at=taken_at)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_dng(path, sensor.quantise(np.minimum(mosaic, 1.0)), sensor, shot)
    if math.isinf(focus_m):
        state_infinity(path)
    return path


def state_infinity(path: Path) -> None:
    """SubjectDistance 0xFFFFFFFF / 1. exiv2 reads that but writes at most 0x7FFFFFFF, so the last bit is set by hand."""
    import pyexiv2

    with pyexiv2.Image(str(path)) as image:
        image.modify_exif({"Exif.Photo.SubjectDistance": "2147483647/1"})
    written, meant = (struct.pack("<II", numerator, 1) for numerator in (0x7FFFFFFF, 0xFFFFFFFF))
    data = path.read_bytes()
    assert data.count(written) == 1
    path.write_bytes(data.replace(written, meant))


@pytest.fixture
def shoot(tmp_path: Path) -> Path:
    """Five DNGs in an order of names that is not the order of their focus."""
    rgb = scene_rgb(72, 96)
    for index, focus_m in enumerate(DISTANCES_M):
        make_raw_photo(tmp_path / "shoot" / f"IMG_{index + 8}.dng", rgb, focus_m, seconds=2 * index)
    return tmp_path / "shoot"


def only_stack(report: IngestReport) -> FocalStack:
    assert len(report.stacks) == 1
    assert report.stacks[0].stack is not None
    return report.stacks[0].stack


def sources(stack: FocalStack) -> list[str]:
    return [each.metadata["source"] for each in stack.slices]


# --- order, lens, camera -------------------------------------------------------------------------------------------


def test_slices_come_nearest_first_with_lens_and_camera(shoot: Path, tmp_path: Path) -> None:
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    assert stack.folder == tmp_path / "scene" / "shoot"
    assert [each.path for each in stack.slices] == [f"slices/{index:02d}.exr" for index in range(5)]
    assert sources(stack) == ["IMG_9.dng", "IMG_10.dng", "IMG_12.dng", "IMG_8.dng", "IMG_11.dng"]
    # EXIF holds the distance from the film plane in steps of 10 micrometres; the thin lens takes it back to the lens.
    assert stack.focus_distances_m == pytest.approx(sorted(DISTANCES_M), rel=1e-4)
    assert stack.reference == 0
    assert stack.lens is not None
    assert stack.camera is not None
    assert (stack.lens.focal_length_mm, stack.lens.f_number, stack.lens.sensor_width_mm) == pytest.approx((35.0, 2.8, 23.5), rel=1e-6)
    assert stack.lens.focus_distance_m == pytest.approx(0.6, rel=1e-4)
    assert stack.camera.focal_px == pytest.approx((LENS.focused_at(0.6).focal_px(96),) * 2, rel=1e-4)
    assert stack.camera.principal_px == (48.0, 36.0)
    read = read_focal_stack(stack.folder)
    assert (read.slices, read.metadata) == (stack.slices, stack.metadata)


def test_slices_hold_the_light_of_the_scene(shoot: Path, tmp_path: Path) -> None:
    """Demosaicing errs at edges and along the border, but not on average: away from lamps and border, areas of 9x9 px must be
    right to 1.2 percent of white (the median over colour differences costs 0.2 at edges of strong colours, and takes more off
    the fringes of lamps), and all of them together to a thousandth."""
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    truth = scene_rgb(72, 96)
    quiet = uniform_filter((truth.max(axis=-1) > 1.0).astype(np.float32), 25) < 1e-6
    quiet[:8], quiet[-8:], quiet[:, :8], quiet[:, -8:] = False, False, False, False
    assert quiet.mean() > 0.3
    for index in range(len(stack)):
        error = uniform_filter(stack.slice_rgb(index), (9, 9, 0)) - uniform_filter(truth, (9, 9, 0))
        assert np.abs(error[quiet]).max() < 0.012
        assert np.abs(error[quiet].mean(axis=0)).max() < 0.001
    metadata = stack.slices[0].metadata
    # Two lamps of 36 photosites.
    assert metadata["saturated_fraction"] == pytest.approx(72 / (72 * 96))
    assert metadata["saturation_level"] == metadata["exposure_gain"] == 1.0
    assert metadata["white_balance"] == pytest.approx([2.0, 1.0, 1.6], abs=1e-3)
    assert stack.slice_rgb(0).max() > 1.3, "lamps lose nothing at 1"


def test_sizes_on_request(shoot: Path, tmp_path: Path) -> None:
    """The lens keeps its sensor width at any size, and area averages keep the mean."""
    full = only_stack(ingest([shoot], tmp_path / "full"))
    narrow = only_stack(ingest([shoot], tmp_path / "narrow", IngestSettings(development=Development(max_width=32))))
    half = only_stack(ingest([shoot], tmp_path / "half", IngestSettings(development=Development(half_size=True))))
    assert narrow.slice_rgb(0).shape == (24, 32, 3)
    assert half.slice_rgb(0).shape == (36, 48, 3)
    assert narrow.slice_rgb(0).mean(axis=(0, 1)) == pytest.approx(full.slice_rgb(0).mean(axis=(0, 1)), rel=1e-5)
    for stack in (narrow, half):
        assert stack.lens is not None
        assert stack.lens.sensor_width_mm == pytest.approx(23.5, rel=1e-6)


def test_infinity_survives_the_file(shoot: Path, tmp_path: Path) -> None:
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    assert read_focal_stack(stack.folder).focus_distances_m[-1] == math.inf


def test_pictures_without_metadata_and_what_a_sidecar_adds(tmp_path: Path) -> None:
    for index in range(3):
        write_image(tmp_path / "shoot" / f"{index}.png", scene_rgb(48, 64, index))
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    stack = only_stack(report)
    assert stack.lens is None
    assert stack.camera is None
    assert sources(stack) == ["0.png", "1.png", "2.png"]
    (remark,) = (each for each in report.stacks[0].remarks if each.startswith("no lens"))
    assert "0.png does not tell focal_length_mm, f_number, sensor_width_mm, focus_distances_m" in remark
    assert "lens.toml" in remark
    (tmp_path / "shoot" / "lens.toml").write_text(
        "focal_length_mm = 50\nf_number = 2\nsensor_width_mm = 36\nblades = 6\nfocus_distances_m = [2.0, 1.0, 0.5]\n"
    )
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    stack = only_stack(report)
    assert stack.lens is not None
    assert (stack.lens.focal_length_mm, stack.lens.focus_distance_m, len(stack.lens.aperture.outlines[0])) == (50.0, 0.5, 6)
    assert (sources(stack), stack.focus_distances_m) == (["2.png", "1.png", "0.png"], (0.5, 1.0, 2.0))


def test_sixteen_bit_and_jpeg_are_decoded_from_srgb(tmp_path: Path) -> None:
    rgb = gaussian_filter(np.minimum(scene_rgb(48, 64), 0.9), (2, 2, 0))
    write_image(tmp_path / "png" / "a.png", rgb)
    write_image(tmp_path / "jpg" / "a.jpg", rgb)
    write_image(tmp_path / "exr" / "a.exr", rgb, half=False)
    for kind, tolerance, dtype in (("png", 2e-5, np.float32), ("jpg", 0.05, np.float16), ("exr", 0.0, np.float32)):
        stack = only_stack(ingest([tmp_path / kind], tmp_path / "scene"))
        assert np.abs(stack.slice_rgb(0) - rgb).max() <= tolerance
        assert read_exr(stack.folder / stack.slices[0].path)[0].channels["R"].dtype == dtype


# --- exposure ------------------------------------------------------------------------------------------------------


def refocused(rgb: Picture, focus: float, gain: float) -> Picture:
    """A slanted plane photographed with focus in 0 .. 1: blur up to 5 % of the width, breathing of 8 %, a vignette that
    grows with focus, saturation at 1 and a gain before it."""
    height, width = rgb.shape[:2]
    place = np.linspace(0.0, 1.0, width)[None, :, None]
    strips = 13
    blurred = np.zeros(rgb.shape)
    for index in range(strips):
        weight = np.clip(1.0 - np.abs(place * (strips - 1) - index), 0.0, 1.0)
        sigma_px = 0.0125 * width * abs(index / (strips - 1) - focus)
        blurred += gaussian_filter(rgb * weight, (sigma_px, sigma_px, 0.0), mode="constant")
    scale = 1.0 / (1.0 + 0.08 * focus)
    middle = np.array([height / 2.0, width / 2.0])
    matrix = np.diag([scale, scale])
    offset = middle - matrix @ (middle + 6.0 * focus)
    breathed = np.stack([affine_transform(blurred[..., each], matrix, offset, order=1, mode="reflect") for each in range(3)], axis=-1)
    y, x = np.mgrid[:height, :width]
    radius_squared = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width**2 / 4 + height**2 / 4)
    vignetted = breathed * (1.0 - (0.15 + 0.05 * focus) * radius_squared[..., None] ** 2)
    return np.minimum(vignetted * gain, 1.0).astype(np.float32)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("focus", "gain"), [(0.25, 0.8), (0.5, 1.3), (0.75, 0.97), (1.0, 0.55)])
def test_known_gains_are_found_within_a_percent(seed: int, focus: float, gain: float) -> None:
    """The first slice is the reference; blur, breathing, vignetting and lamps that saturate must not pass for exposure."""
    rgb = scene_rgb(240, 320, seed)
    reference, other = refocused(rgb, 0.0, 1.0), refocused(rgb, focus, gain)
    low, low_other = (low_frequency(each, np.any(each >= 1.0, axis=-1)) for each in (reference, other))
    assert measure_gain(low, low_other) == pytest.approx(1.0 / gain, rel=0.01)


def test_gains_are_limited_and_small_ones_left_alone() -> None:
    rgb = np.minimum(scene_rgb(96, 128), 0.6)
    none_full = np.zeros(rgb.shape[:2], bool)

    def gain_of(factor: float, stated: float | None) -> ExposureGain:
        return evened_out(low_frequency(rgb, none_full), low_frequency(rgb * np.float32(factor), none_full), stated)

    assert gain_of(1.005, None).total == 1.0  # within the error of measurement
    assert gain_of(0.5, 2.0).total == pytest.approx(2.0)  # metadata explain it
    assert gain_of(0.45, 2.0).total == pytest.approx(1 / 0.45, rel=0.01)  # and nearly do
    assert gain_of(0.25, 2.0).total == pytest.approx(2.0 * 1.26)  # a third of a stop on top, not more
    assert gain_of(0.25, 2.0).was_limited
    assert gain_of(0.25, None).total == pytest.approx(2.0)  # one stop where nothing was stated


def test_stated_exposure_is_evened_out(tmp_path: Path) -> None:
    """Half the exposure time, half the raw signal: the slices agree after a gain of 2."""
    rgb = gaussian_filter(np.minimum(scene_rgb(72, 96), 0.5), (1, 1, 0))
    make_raw_photo(tmp_path / "shoot" / "0.dng", rgb, 0.6)
    make_raw_photo(tmp_path / "shoot" / "1.dng", rgb, 0.8, Fraction(1, 120))
    stack = only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene"))
    metadata = stack.slices[1].metadata
    assert metadata["exposure_gain"] == pytest.approx(2.0)
    assert metadata["exposure_gain_stated"] == pytest.approx(2.0)
    assert metadata["exposure_gain_measured"] == pytest.approx(2.0, rel=0.002)
    assert metadata["saturation_level"] == pytest.approx(2.0)
    assert stack.slice_rgb(1).mean(axis=(0, 1)) == pytest.approx(stack.slice_rgb(0).mean(axis=(0, 1)), rel=0.002)


def test_one_white_balance_for_the_stack(shoot: Path, tmp_path: Path) -> None:
    """The camera chose another one for the second file: the first file's holds for both, so that equal light stays equal."""
    import pyexiv2

    with pyexiv2.Image(str(shoot / "IMG_9.dng")) as image:
        image.modify_exif({"Exif.Image.AsShotNeutral": "9/10 1/1 5/10"})
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    assert sources(stack)[0] == "IMG_9.dng"
    assert all(each.metadata["white_balance"] == stack.slices[1].metadata["white_balance"] for each in stack.slices)
    assert np.array_equal(stack.slice_rgb(0), stack.slice_rgb(1))
    given = IngestSettings(development=Development(white_balance=(1.5, 1.0, 1.2)))
    assert only_stack(ingest([shoot], tmp_path / "given", given)).slices[0].metadata["white_balance"] == [1.5, 1.0, 1.2]


def test_folders_of_a_scene_become_stacks(tmp_path: Path) -> None:
    for view in ("view_0", "view_1"):
        for index in range(2):
            make_raw_photo(tmp_path / "shoot" / view / f"{index}.dng", scene_rgb(24, 32), 0.5 + index)
    report = ingest([tmp_path / "shoot"], tmp_path / "shoot" / "scene")
    assert [each.name for each in report.stacks] == ["view_0", "view_1"]
    # Its own results are no photographs, although they lie within the folder that was named.
    again = ingest([tmp_path / "shoot"], tmp_path / "shoot" / "scene")
    assert [(each.name, each.kept) for each in again.stacks] == [("view_0", 2), ("view_1", 2)]


# --- damaged files, odd sizes, reruns ------------------------------------------------------------------------------


def test_damaged_files_are_named_and_the_rest_goes_on(shoot: Path, tmp_path: Path) -> None:
    (shoot / "IMG_13.dng").write_text("just a text\n" * 99)
    truncated = (shoot / "IMG_12.dng").read_bytes()
    (shoot / "IMG_12.dng").write_bytes(truncated[: len(truncated) // 2])
    (shoot / "IMG_14.jpg").write_bytes(b"\xff\xd8\xff\xe0 not a JPEG")
    report = ingest([shoot], tmp_path / "scene")
    stack = only_stack(report)
    assert sources(stack) == ["IMG_9.dng", "IMG_10.dng", "IMG_8.dng", "IMG_11.dng"], "and they are in order of focus all the same"
    assert [each.path for each in stack.slices] == [f"slices/{index:02d}.exr" for index in range(4)], "without a gap"
    reasons = {each.path.name: each.reason for each in report.stacks[0].skipped}
    assert set(reasons) == {"IMG_12.dng", "IMG_13.dng", "IMG_14.jpg"}
    assert "cannot be decoded as RAW" in reasons["IMG_13.dng"]
    assert {each["source"].split("/")[-1] for each in stack.metadata["skipped"]} == set(reasons)


def test_nothing_usable_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "shoot").mkdir()
    with pytest.raises(InputError, match="found none"):
        ingest([tmp_path / "shoot"], tmp_path / "scene")
    (tmp_path / "shoot" / "text.dng").write_text("just a text")
    with pytest.raises(InputError, match=r"none of the 1 files .* text\.dng: it cannot be decoded"):
        ingest([tmp_path / "shoot"], tmp_path / "scene")


def test_a_picture_of_another_size_is_left_out(tmp_path: Path) -> None:
    """Also when it is the first, from which exposure was taken: then the others are evened out among themselves."""
    write_image(tmp_path / "shoot" / "0.png", np.minimum(scene_rgb(60, 64), 0.6))
    for index, factor in ((1, 1.0), (2, 0.8)):
        write_image(tmp_path / "shoot" / f"{index}.png", np.minimum(scene_rgb(48, 64), 0.6) * np.float32(factor))
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    stack = only_stack(report)
    assert sources(stack) == ["1.png", "2.png"]
    assert [each.reason for each in report.stacks[0].skipped] == ["64x60 px, but most of its stack have 64x48 px"]
    assert stack.metadata["exposure_reference"] == "1.png"
    assert [each.metadata["exposure_gain"] for each in stack.slices] == pytest.approx([1.0, 1.25], rel=0.005)
    assert len(list((stack.folder / "slices").iterdir())) == 2


def test_a_rerun_keeps_everything_and_a_merged_stack_too(shoot: Path, tmp_path: Path) -> None:
    from mrbokeh.focal_stack import write_focal_stack

    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    write_focal_stack(replace(stack, merged=True))
    before = {path: path.stat().st_mtime_ns for path in stack.folder.rglob("*") if path.is_file()}
    report = ingest([shoot], tmp_path / "scene")
    assert report.stacks[0].kept == 5
    assert {path: path.stat().st_mtime_ns for path in stack.folder.rglob("*") if path.is_file()} == before
    assert only_stack(report).merged
    report = ingest([shoot], tmp_path / "scene", IngestSettings(overwrite=True))
    assert report.stacks[0].kept == 0
    assert not only_stack(report).merged
    assert all(path.stat().st_mtime_ns > before[path] for path in (stack.folder / "slices").iterdir())


def test_only_what_changed_is_made_again(shoot: Path, tmp_path: Path) -> None:
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    (shoot / "IMG_10.dng").unlink()
    os.utime(shoot / "IMG_8.dng", ns=(1, 1))
    make_raw_photo(shoot / "IMG_7.dng", scene_rgb(72, 96), 0.7)
    report = ingest([shoot], tmp_path / "scene")
    assert report.stacks[0].kept == 3
    assert sources(only_stack(report)) == ["IMG_9.dng", "IMG_7.dng", "IMG_12.dng", "IMG_8.dng", "IMG_11.dng"]
    assert len(list((stack.folder / "slices").iterdir())) == 5, "the slice of the deleted photograph is gone"


def test_an_interrupted_run_goes_on_and_ends_the_same(shoot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = only_stack(ingest([shoot], tmp_path / "whole"))
    developed: list[str] = []
    real_develop = capture.stacks.stack_ingest.develop

    def counting(path: Path, *args: object, **kwargs: object) -> object:
        if len(developed) == 3:
            raise KeyboardInterrupt
        developed.append(path.name)
        return real_develop(path, *args, **kwargs)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(capture.stacks.stack_ingest, "develop", counting)
        with pytest.raises(KeyboardInterrupt):
            ingest([shoot], tmp_path / "scene")
    assert developed == ["IMG_9.dng", "IMG_10.dng", "IMG_12.dng"]
    assert len(find_slices(tmp_path / "scene" / "shoot")) == 3
    report = ingest([shoot], tmp_path / "scene")
    stack = only_stack(report)
    assert report.stacks[0].kept == 3
    assert (stack.slices, stack.metadata) == (whole.slices, whole.metadata)
    assert all(np.array_equal(stack.slice_rgb(index), whole.slice_rgb(index)) for index in range(5))
    assert not [path for path in stack.folder.rglob("*") if path.name.startswith((".", "made_", "moving_"))]


def test_copies_of_one_photograph_stay_apart(tmp_path: Path) -> None:
    """Same name, size and time in two folders, put into one stack: two slices, also on the next run."""
    path = make_raw_photo(tmp_path / "a" / "0.dng", scene_rgb(24, 32), 0.6)
    (tmp_path / "b").mkdir()
    shutil.copy2(path, tmp_path / "b" / "0.dng")
    folders = [tmp_path / "a", tmp_path / "b"]
    for max_width in (None, 16, None):
        settings = IngestSettings(grouping=Grouping.none, development=Development(max_width=max_width))
        assert len(only_stack(ingest(folders, tmp_path / "scene", settings))) == 2


# --- the command, real stacks --------------------------------------------------------------------------------------


def test_the_command_prints_a_table(shoot: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["ingest", str(shoot), "--out", str(tmp_path / "scene"), "--white-balance", "4,2,3.2"], env={"COLUMNS": "160"}
    )
    assert result.exit_code == 0, result.output
    assert "96x72" in result.output
    assert "0.6 .. inf m" in result.output
    assert "35 mm f/2.8" in result.output
    assert "--white-balance 2,1,1.6" in result.output


@pytest.mark.parametrize("command", ["ingest", "merge"])
def test_help_shows_an_example(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--help"])
    assert result.exit_code == 0
    assert f"Example:  mrbokeh capture {command}" in result.output


@pytest.mark.parametrize("text", ["auto", "1,2", "1,2,x", "0,1,1", "1,-1,1", "inf,1,1", "nan,1,1"])
def test_white_balance_mistakes(text: str) -> None:
    assert parse_white_balance("camera") is None
    assert parse_white_balance("4,2,3") == (2.0, 1.0, 1.5)
    with pytest.raises(InputError, match="--white-balance"):
        parse_white_balance(text)


def test_a_real_jpeg_stack(shared_data: Path, tmp_path: Path) -> None:
    """Seven slices; the merged picture of the source's authors beside them names no camera and is left out."""
    report = ingest([shared_data / "stacks" / "pcb_oblique"], tmp_path, IngestSettings(development=Development(max_width=512)))
    stack = only_stack(report)
    assert sources(stack) == [f"{index:02d}.jpg" for index in range(1, 8)]
    assert [each.path.name for each in report.stacks[0].skipped] == ["reference_fused.jpg"]
    assert stack.slice_rgb(0).shape == (384, 512, 3)
    assert stack.slices[0].metadata["exposure_time_s"] == pytest.approx(1 / 126)
    # After evening out, the middle of neighbouring slices is equally bright to the 3 % that its changing content explains.
    middles = [np.median(stack.slice_rgb(index)[96:288, 128:384].mean(axis=-1)) for index in range(7)]
    assert np.ptp(middles) / np.mean(middles) < 0.12
    assert all(0.9 < each.metadata["exposure_gain"] < 1.1 for each in stack.slices)


@pytest.mark.skipif(not (DEMO_STACK / "truth.json").is_file(), reason="the RAW stack with truth is not in mrbokeh/demo_data")
def test_the_shipped_raw_stack_matches_its_truth(tmp_path: Path) -> None:
    """All views whole, the lens as stated, and per channel the light of the truth: defocus conserves the mean, so that the
    inner part of each slice, scaled to the reference by its focal length, must have the mean of the sharp truth.

    Half a percent is what is asked of the colour path; blur across the border of the area, noise and the saturated
    lamps (left out with what lies around them) take some of it.
    """
    truth = json.loads((DEMO_STACK / "truth.json").read_text())
    report = ingest([DEMO_STACK], tmp_path)
    assert [each.name for each in report.stacks] == [f"view_{index}" for index in range(truth["plan"]["viewpoints"])]
    for stack in (each.stack for each in report.stacks):
        assert stack is not None
        assert stack.focus_distances_m == pytest.approx(truth["focus_distances_m"], rel=1e-4)
        assert stack.lens is not None
        assert stack.lens.sensor_width_mm == pytest.approx(truth["lens"]["sensor_width_mm"], rel=1e-6)
        sharp = read_image(DEMO_STACK / "truth" / stack.folder.name / "all_in_focus.exr")
        ratios = [mean_ratio(stack.slice_rgb(index), sharp, truth["focal_px"][0] / truth["focal_px"][index]) for index in range(len(stack))]
        assert np.abs(np.array(ratios) - 1.0).max() < 0.005
        assert [each.metadata["exposure_gain"] for each in stack.slices] == [1.0] * len(stack)
        assert [each.metadata["exposure_gain_measured"] for each in stack.slices[1:]] == pytest.approx([1.0] * (len(stack) - 1), abs=0.002)


def mean_ratio(rgb: Picture, sharp: Picture, reference_from_slice: float) -> Float32[np.ndarray, "3"]:
    """Mean of a slice over that of the truth per channel, 40 px inside the border and away from lights above white."""
    height, width = sharp.shape[:2]
    middle = np.array([height / 2 - 0.5, width / 2 - 0.5])
    matrix = np.eye(2) / reference_from_slice
    scaled = np.stack(
        [affine_transform(rgb[..., each], matrix, middle - matrix @ middle, order=1, mode="nearest") for each in range(3)], axis=-1
    )
    inside = np.zeros((height, width), bool)
    inside[40:-40, 40:-40] = True
    inside &= uniform_filter((sharp.max(axis=-1) > 0.9).astype(np.float32), 61) < 1e-6
    return (scaled[inside].mean(axis=0) / sharp[inside].mean(axis=0)).astype(np.float32)
