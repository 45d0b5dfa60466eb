"""Photographs into focal stacks: what belongs to one, order, lens, camera, sizes, the command; odd ones are named or left out."""

import math
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import tifffile
from jaxtyping import Float64
from PIL import Image
from scipy.ndimage import gaussian_filter, uniform_filter

from capture.cli import app
from capture.commands.ingest import parse_white_balance
from capture.photos.focus_metadata import FocusReading
from capture.photos.photo_files import find_photos
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sidecar import Sidecar
from capture.stacks.grouping import Grouping, Photo, PhotoGroup, by_camera, group_photos, why_aside
from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.stack_ingest import Development
from datasets_scripts.made_sets.simulated_camera import SensorModel
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import write_image
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.stacks.photograph import read_photograph
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from tests.support.made_photographs import (
    DISTANCES_M,
    LENS,
    defocused,
    make_raw_photo,
    make_shoot,
    only_stack,
    scene_rgb,
    set_exif,
    sources,
)
from tests.support.refusals import refused


@pytest.fixture
def shoot(tmp_path: Path) -> Path:
    return make_shoot(tmp_path / "shoot")


def test_slices_come_nearest_first_with_lens_and_camera(shoot: Path, tmp_path: Path) -> None:
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    assert stack.folder == tmp_path / "scene" / "shoot"
    assert [each.path for each in stack.slices] == [f"slices/{index:02d}.exr" for index in range(5)]
    assert sources(stack) == ["IMG_9.dng", "IMG_10.dng", "IMG_12.dng", "IMG_8.dng", "IMG_11.dng"]
    # EXIF holds the distance from the film plane in steps of 10 micrometres; the thin lens takes it back to the lens.
    assert stack.focus_distances_m == pytest.approx(sorted(DISTANCES_M), rel=1e-4)
    assert stack.reference == 0
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
        assert stack.lens.sensor_width_mm == pytest.approx(23.5, rel=1e-6)


def test_masks_and_primaries_travel_with_the_slices(shoot: Path, tmp_path: Path) -> None:
    """Two lamps of 6x6 full photosites, 2 px more on each side: 200 pixels of camera RGB, with the way to Rec.709 beside them."""
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    assert np.array(stack.rec709_from_camera) == pytest.approx(np.linalg.inv(camera_from_rec709()), abs=2e-3)
    masks = stack.slice_masks(0)
    assert (int(masks.saturated.sum()), bool(masks.valid.all())) == (200, True)
    assert stack.slice_camera_rgb(0)[masks.saturated].max() == pytest.approx(2.0, rel=1e-3), "red is full at its white balance"
    reduced = only_stack(ingest([shoot], tmp_path / "narrow", IngestSettings(development=Development(max_width=48))))
    covered = masks.saturated.reshape(36, 2, 48, 2).any(axis=(1, 3))
    np.testing.assert_array_equal(reduced.slice_masks(0).saturated, covered)


def camera_from_rec709() -> Float64[np.ndarray, "3 3"]:
    """White-balanced: rows sum to 1."""
    sensor = SensorModel()
    return sensor.camera_from_rec709 / sensor.as_shot_neutral[:, None]


def test_distances_are_kept_with_interval_and_origin(shoot: Path, tmp_path: Path) -> None:
    """EXIF counts from the film plane: d + d_s + hiatus; a focus.csv says more of one file, from the lens."""
    (shoot / "lens.toml").write_text("hiatus_mm = 10\n")
    (shoot / "focus.csv").write_text("file,focus_distance_m,nearest_m,farthest_m\nIMG_11.dng,5,4,inf\n")
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    assert sources(stack)[-1] == "IMG_11.dng"
    for each, without_hiatus_m in zip(stack.slices[:4], sorted(DISTANCES_M), strict=False):
        focus, distance_m = each.metadata["focus"], each.focus_distance_m
        assert (focus["origin"], focus["hiatus_mm"]) == ("film_plane", 10.0)
        assert distance_m is not None and distance_m < without_hiatus_m
        film_plane_m = distance_m + 0.01 + LENS.focused_at(distance_m).image_distance_mm / 1000.0
        assert film_plane_m == pytest.approx(1.0 / focus["stated_dioptre"], rel=1e-9)
        farthest, nearest = focus["lens_interval_dioptre"]
        assert focus["lens_dioptre"] == pytest.approx(1.0 / distance_m)
        assert farthest < focus["lens_dioptre"] < nearest
    stated = stack.slices[4].metadata["focus"]
    assert (stated["origin"], stated["lens_dioptre"], stated["lens_interval_dioptre"]) == ("lens", 0.2, [0.0, 0.25])


def test_pictures_without_metadata_and_what_a_sidecar_adds(tmp_path: Path) -> None:
    for index in range(3):
        write_image(tmp_path / "shoot" / f"{index}.png", defocused(scene_rgb(48, 64), index))
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


def test_folders_of_a_scene_become_stacks(tmp_path: Path) -> None:
    for view in ("view_0", "view_1"):
        for index in range(2):
            make_raw_photo(tmp_path / "shoot" / view / f"{index}.dng", scene_rgb(24, 32), 0.5 + index)
    report = ingest([tmp_path / "shoot"], tmp_path / "shoot" / "scene")
    assert [each.name for each in report.stacks] == ["view_0", "view_1"]
    # Its own results are no photographs, although they lie within the folder that was named.
    again = ingest([tmp_path / "shoot"], tmp_path / "shoot" / "scene")
    assert [(each.name, each.kept) for each in again.stacks] == [("view_0", 2), ("view_1", 2)]


def test_the_command_prints_a_table(shoot: Path, tmp_path: Path) -> None:
    told = printed_by(app, "ingest", shoot, "--out", tmp_path / "scene", "--white-balance", "4,2,3.2")
    for part in ("96x72", "0.6 .. inf m", "35 mm f/2.8", "--white-balance 2,1,1.6"):
        assert part in told


def test_what_is_no_photograph_is_told_in_one_line(shoot: Path, tmp_path: Path) -> None:
    """Sidecars are read and hidden files are nobody's; where photographs are named one by one, nobody asked for the rest."""
    for name in ("notes.txt", "clip.mov", ".hidden", "lens.toml", *(f"IMG_{index}.xmp" for index in range(8, 13))):
        (shoot / name).write_text("")
    named = sorted(shoot.glob("*.dng"))
    for given, told in (([shoot], "clip.mov, IMG_8.xmp, IMG_9.xmp, IMG_10.xmp, IMG_11.xmp ... (7 files)"), (named, None)):
        printed = printed_by(app, "ingest", *given, "--out", tmp_path / "scene")
        lines = [each for each in printed.splitlines() if each.startswith("not photographs")]
        assert lines == ([] if told is None else [f"not photographs, left out: {told}"])
    (shoot / "my.toml").write_text("")
    (tmp_path / "shoot" / "aside").mkdir()
    report = ingest([shoot], tmp_path / "scene", IngestSettings(sidecar=shoot / "my.toml"))
    assert {each.name for each in report.no_photographs} == {"notes.txt", "clip.mov", *(f"IMG_{index}.xmp" for index in range(8, 13))}


@pytest.mark.parametrize("text", ["auto", "1,2", "1,2,x", "0,1,1", "1,-1,1", "inf,1,1", "nan,1,1"])
def test_white_balance_mistakes(text: str) -> None:
    assert parse_white_balance("camera") is None
    assert parse_white_balance("4,2,3") == (2.0, 1.0, 1.5)
    refused("--white-balance", parse_white_balance, text)


def photo(name: str, seconds: float | None = None, focus_m: float | None = None, camera: str | None = "A") -> Photo:
    taken_at = None if seconds is None else datetime(2025, 1, 1) + timedelta(seconds=seconds)
    focus = None if focus_m is None else FocusReading(focus_m, focus_m, focus_m, "lens", "test")
    return Photo(Path(name), PhotoMetadata(taken_at=taken_at, focus=focus, camera_model=camera), Sidecar())


def names(photos: Sequence[Photo]) -> list[str]:
    return [each.path.name for each in photos]


def test_group_by_time_splits_at_long_pauses() -> None:
    """Shots 3 s apart with pauses of two minutes; names not in the order of time."""
    seconds = {"b": 0, "a": 3, "c": 6, "d": 126, "e": 129, "f": 250}
    groups = group_photos([("shoot", [photo(name, seconds=seconds[name]) for name in "abcdef"])], Grouping.time)
    assert [(group.name, names(group.photos)) for group in groups] == [
        ("shoot_00", ["b", "a", "c"]),
        ("shoot_01", ["d", "e"]),
        ("shoot_02", ["f"]),
    ]


def test_group_by_focus_splits_where_the_focus_turns() -> None:
    """Two sweeps near to far (the second from the start again), one back; equal distances are no turn."""
    distances_m = [0.5, 0.7, 0.7, 2.0, math.inf, 0.5, 0.7, 2.0, 1.0, 0.5]
    photos = [photo(f"{index}", focus_m=distance) for index, distance in enumerate(distances_m)]
    assert [names(group.photos) for group in group_photos([("s", photos)], Grouping.focus)] == [list("01234"), list("567"), list("89")]


def test_group_by_folder_and_none() -> None:
    folders = [("x", [photo("0")]), ("y", [photo("1")]), ("x", [photo("2")])]
    assert [group.name for group in group_photos(folders, Grouping.folder)] == ["x", "y", "x_2"]
    assert [names(group.photos) for group in group_photos(folders, Grouping.none)] == [["0", "1", "2"]]


def test_grouping_needs_what_it_goes_by() -> None:
    with pytest.raises(InputError, match="needs the time of each photograph, but b do not state it"):
        group_photos([("s", [photo("a", seconds=0), photo("b")])], Grouping.time)
    refused("needs the focus distance of each photograph", group_photos, [("s", [photo("a"), photo("b", focus_m=1.0)])], Grouping.focus)


def test_a_camera_with_one_picture_lies_aside() -> None:
    photos = (
        photo("a.jpg"),
        photo("b.jpg"),
        photo("other.jpg", camera="B"),
        photo("fused.jpg", camera=None),
        photo("bad.dng", camera=None),
    )
    (group,) = by_camera(PhotoGroup("shoot", photos))
    assert names(group.photos) == ["a.jpg", "b.jpg", "bad.dng"]
    assert [(each.path.name, each.reason.split(",")[0]) for each in why_aside(group)] == [
        ("other.jpg", "it was taken with B"),
        ("fused.jpg", "it names no camera"),
    ]


def test_cameras_with_two_pictures_or_more_make_a_stack_each() -> None:
    cameras = {"a": "A", "b": "Model B/2", "c": "A", "d": "Model B/2", "e": "A"}
    groups = group_photos([("shoot", [photo(name, camera=camera) for name, camera in cameras.items()])], Grouping.folder)
    assert [(group.name, names(group.photos)) for group in groups] == [("shoot", ["a", "c", "e"]), ("shoot_Model_B_2", ["b", "d"])]
    assert all(
        group.remarks == ("photographs of 2 cameras, a stack for each: shoot (A, 3), shoot_Model_B_2 (Model B/2, 2)",) for group in groups
    )


def test_cameras_with_one_picture_each_make_one_stack() -> None:
    """Nothing is the usual one there, so nothing is thrown away."""
    (group,) = by_camera(PhotoGroup("shoot", tuple(photo(name, camera=name.upper()) for name in "abc")))
    assert (names(group.photos), group.aside) == (["a", "b", "c"], ())
    assert group.remarks == ("its 3 photographs name 3 cameras, none of them twice: one stack",)


def test_which_files_are_photographs(tmp_path: Path) -> None:
    for name in ("b10.jpg", "b9.jpg", "a.CR2", "a.jpg", ".hidden.jpg", "notes.txt", "depth.exr"):
        (tmp_path / name).write_text("")
    (folder,), skipped = find_photos([tmp_path], tmp_path / "scene")
    assert [path.name for path in folder.paths] == ["a.CR2", "b9.jpg", "b10.jpg"]
    assert {each.path.name for each in skipped} == {"a.jpg", "depth.exr"}
    (folder,), skipped = find_photos([tmp_path / "depth.exr", tmp_path / "notes.txt"], tmp_path / "scene")
    assert [path.name for path in folder.paths] == ["depth.exr"]
    assert [each.path.name for each in skipped] == ["notes.txt"]
    refused("there is nothing at", find_photos, [tmp_path / "absent"], tmp_path / "scene")
    refused("give another folder with --out", find_photos, [tmp_path], tmp_path / ".")


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


def test_a_jpeg_beside_a_broken_raw_is_not_dropped_without_a_word(shoot: Path, tmp_path: Path) -> None:
    """Beside a good one it is what everybody expects; also when the stack was made before."""

    for name in ("IMG_9.jpg", "IMG_10.jpg"):
        write_image(shoot / name, scene_rgb(72, 96))
    (shoot / "IMG_10.dng").write_bytes((shoot / "IMG_10.dng").read_bytes()[:3000])
    for _ in range(2):
        report = ingest([shoot], tmp_path / "scene")
        reasons = {each.path.name: each.reason for each in report.skipped}
        assert reasons["IMG_9.jpg"] == "the same shot as IMG_9.dng, which is RAW"
        assert "IMG_10.dng, which is RAW but cannot be used: copy IMG_10.dng again, or move it elsewhere" in reasons["IMG_10.jpg"]
    (shoot / "IMG_10.dng").rename(tmp_path / "IMG_10.dng")
    set_exif(shoot / "IMG_10.jpg", Model="Simulated Bayer Camera")
    assert "IMG_10.jpg" in sources(only_stack(ingest([shoot], tmp_path / "scene")))


def test_nothing_usable_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "shoot").mkdir()
    refused("HEIC.* found none", ingest, [tmp_path / "shoot"], tmp_path / "scene")
    (tmp_path / "shoot" / "text.dng").write_text("just a text")
    refused(r"none of the 1 files .* text\.dng: it cannot be decoded", ingest, [tmp_path / "shoot"], tmp_path / "scene")


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


def test_one_photograph_is_a_stack_that_says_what_it_lacks(tmp_path: Path) -> None:
    make_raw_photo(tmp_path / "shoot" / "0.dng", scene_rgb(24, 32), 0.6)
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    assert len(only_stack(report)) == 1
    assert any("a stack of 1 slice: merging needs at least 2" in remark for remark in report.stacks[0].remarks)


def test_names_that_do_not_follow_the_time_are_remarked_where_focus_is_unknown(tmp_path: Path) -> None:
    """IMG_8 .. IMG_12 are in order of time, natural sorting given; renamed they are not."""
    shoot = make_shoot(tmp_path / "shoot", blur_px=1.0)
    for path in shoot.iterdir():
        set_exif(path, SubjectDistance="0/1")
    report = ingest([shoot], tmp_path / "scene")
    assert sources(only_stack(report)) == [f"IMG_{index}.dng" for index in range(8, 13)]
    assert not any("not that in which they were taken" in remark for remark in report.stacks[0].remarks)
    (shoot / "IMG_8.dng").rename(shoot / "IMG_99.dng")
    report = ingest([shoot], tmp_path / "scene")
    assert any("not that in which they were taken" in remark for remark in report.stacks[0].remarks)


def test_what_is_no_number_in_a_tiff_of_floats_becomes_light_and_is_told(tmp_path: Path) -> None:
    rgb = np.full((6, 8, 3), 0.25, np.float32)
    rgb[1, 2], rgb[3, 4, 0] = np.nan, np.inf
    tifffile.imwrite(tmp_path / "float.tif", rgb, photometric="rgb")
    read = read_photograph(tmp_path / "float.tif")
    assert np.isfinite(read.rgb).all() and (read.rgb[1, 2] == 0.0).all() and read.rgb[3, 4, 0] > 1e4
    assert read.rgb[0, 0, 0] == np.float32(0.25)


def test_pictures_larger_than_pillow_would_decode_keep_their_orientation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (12, 8), (90, 90, 90)).save(tmp_path / "large.jpg", exif=exif)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 4)
    assert read_photograph(tmp_path / "large.jpg").rgb.shape == (12, 8, 3)
    assert Image.MAX_IMAGE_PIXELS == 4
