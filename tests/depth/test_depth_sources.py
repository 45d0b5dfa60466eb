"""Depth of a photograph from files: what the numbers mean, and that edges come out hard where the photograph has them."""

import base64
import hashlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.depth.depth_filters import guided_upsampling, refined_dioptres
from mrbokeh.depth.depth_map import DepthSettings, StereoCalibration, parse_known, parse_near_far, parse_stereo, without_steps
from mrbokeh.depth.open_depth import depth_of_file, open_depth
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.color import linear_to_srgb, srgb_to_linear
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import read_depth, read_image
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

GREY = np.full((24, 32, 3), 0.2, np.float32)


def png(path: Path, numbers: np.ndarray) -> Path:
    cv2.imencode(".png", numbers)[1].tofile(path)
    return path


def test_exr_is_metres_untouched_and_takes_nearest_pixels_so_that_no_depth_is_made_up(tmp_path: Path) -> None:
    depth_m = np.random.default_rng(0).uniform(0.5, 9.0, (24, 32)).astype(np.float32)
    depth_m[3, 4] = np.inf
    write_exr(tmp_path / "z.exr", ExrPart({"Z": depth_m}))
    found = open_depth(tmp_path / "z.exr", GREY)
    np.testing.assert_array_equal(found.depth_m, depth_m)
    assert found.valid.all() and found.note == "z.exr"
    depth_m = np.full((12, 16), 4.0, np.float32)
    depth_m[:, :8] = 1.0
    write_exr(tmp_path / "z.exr", ExrPart({"Z": depth_m}))
    assert set(np.unique(open_depth(tmp_path / "z.exr", GREY).depth_m)) == {1.0, 4.0}


def test_sixteen_bit_depth_and_stereo_disparity(tmp_path: Path) -> None:
    """0 is unknown and takes the depth of its nearest known pixel."""
    numbers = np.full((24, 32), 1500, np.uint16)
    numbers[:, 16:], numbers[5, 20] = 2500, 0
    found = open_depth(png(tmp_path / "z.png", numbers), GREY, DepthSettings(metres_per_unit=0.001))
    assert found.depth_m[0, 0] == pytest.approx(1.5) and found.depth_m[5, 20] == pytest.approx(2.5)
    assert not found.valid[5, 20] and found.valid.sum() == 24 * 32 - 1
    # depth = f b / (d + doffs): 1000 px, 0.2 m and 20 px of offset give 200 / 50 = 4 m for 30 px.
    disparity = np.full((24, 32), 30.0, np.float32)
    disparity[0, 0] = np.inf
    np.savez(tmp_path / "d.npz", disparity)
    found = open_depth(tmp_path / "d.npz", GREY, DepthSettings(stereo=StereoCalibration(1000.0, 0.2, 20.0)))
    assert np.allclose(found.depth_m, 4.0) and found.valid.sum() == 24 * 32 - 1
    refused("--stereo-cameras", open_depth, tmp_path / "d.npz", GREY)


def test_arrays_hold_metres_by_name_or_as_stated(tmp_path: Path) -> None:
    """Networks of metric depth write an array named depth; of others only the user knows what they mean. 0 and NaN are unknown."""
    depth_m = np.linspace(1.0, 4.0, 24 * 32, dtype=np.float32).reshape(1, 24, 32)
    depth_m[0, 3, 4:6] = 0.0, np.nan
    depth_m[0, 9, 9] = np.inf  # background, and no hole
    np.savez(tmp_path / "named.npz", focallength_px=900.0, depth=depth_m)
    np.save(tmp_path / "plain.npy", depth_m)
    settings = {"named.npz": DepthSettings(exact=True), "plain.npy": DepthSettings(metres_per_unit=1.0, exact=True)}
    known = depth_m[0] > 0
    for name, stated in settings.items():
        found = open_depth(tmp_path / name, GREY, stated)
        assert np.array_equal(found.depth_m[known], depth_m[0][known]) and not np.isnan(found.depth_m).any()
        assert np.array_equal(depth_of_file(tmp_path / name, with_holes=True)[known], depth_m[0][known])
    near = open_depth(tmp_path / "plain.npy", GREY, DepthSettings((1.0, 2.0), exact=True))
    assert near.depth_m[-1, -1] == pytest.approx(1.0) and near.depth_m[0, 0] == pytest.approx(1.6)  # a quarter of the way from 0 to 4
    refused("--depth-scale METRES_PER_STEP", open_depth, tmp_path / "plain.npy", GREY)
    (tmp_path / "junk.npz").write_bytes(b"no array")
    refused("damaged or something else", open_depth, tmp_path / "junk.npz", GREY)


@pytest.mark.parametrize(("dtype", "full"), [(np.uint8, 255), (np.uint16, 65535)])
def test_disparity_is_even_in_dioptres_between_near_and_far(tmp_path: Path, dtype: type, full: int) -> None:
    """NEAR 0.5 m is 2 dioptres, FAR inf is 0: a number of a fifth of the range is 0.4 dioptres, 2.5 m."""
    numbers: np.ndarray = np.zeros((24, 32), dtype)
    numbers[:12], numbers[12:, :16] = full, full // 5
    settings = DepthSettings(near_far_m=(0.5, np.inf), refined=False)
    found = open_depth(png(tmp_path / "d.png", numbers), GREY, settings).depth_m
    one_step = 1e-5 if dtype is np.uint16 else 5 / full  # 8 bits are smoothed within a step
    assert found[0, 0] == pytest.approx(0.5) and found[20, 3] == pytest.approx(2.5, rel=one_step) and np.isinf(found[20, 30])


def test_what_does_not_say_its_meaning_is_refused(tmp_path: Path) -> None:
    level, turned, known = (png(tmp_path / "d.png", np.zeros((24, 32), np.uint16)), tmp_path / "turned.png", DepthSettings((1.0, 2.0)))
    png(turned, np.zeros((32, 24), np.uint16))
    (tmp_path / "broken.png").write_bytes(b"no picture")
    for path, settings, said in (
        (level, DepthSettings(), "--disparity NEAR:FAR"),
        (turned, known, "one view"),
        (tmp_path / "absent.exr", DepthSettings(), "no such file"),
        (tmp_path / "broken.png", known, "cannot be read"),
    ):
        refused(said, open_depth, path, GREY, settings)


def test_settings_from_text() -> None:
    assert parse_near_far("0.5:inf") == (0.5, np.inf)
    assert parse_stereo("994.978,0.193,31.086") == StereoCalibration(994.978, 0.193, 31.086)
    assert parse_stereo("1000,0.1") == StereoCalibration(1000.0, 0.1, 0.0)
    assert parse_known("3,4,1.5").depth_m == 1.5
    for parse, text in ((parse_near_far, "1"), (parse_stereo, "1000"), (parse_known, "1,2"), (parse_known, "1,2,0")):
        refused("expected", parse, text)
    wrong: dict
    for wrong in ({"near_far_m": (2.0, 1.0)}, {"metres_per_unit": 0.0}, {"model_gives": "depth"}):
        with pytest.raises(InputError):
            DepthSettings(**wrong)


def test_motorcycle_of_middlebury(shared_data: Path) -> None:
    """Its calibration gives 2.1 m for the nearest wheel and 5 m for the wall (Scharstein et al. 2014, quarter size)."""
    folder = shared_data / "rgbd"
    settings = DepthSettings(stereo=StereoCalibration(994.978, 0.193001, 31.086))
    found = open_depth(folder / "motorcycle_disp.npz", read_image(folder / "motorcycle_left.png"), settings)
    assert found.depth_m.min() == pytest.approx(0.193001 * 994.978 / (59.906 + 31.086), rel=0.01)
    assert found.depth_m.max() == pytest.approx(0.193001 * 994.978 / (7.1914 + 31.086), rel=0.001)
    assert found.valid.mean() == pytest.approx(0.927, abs=0.001) and np.isfinite(found.depth_m).all()


def test_real_soft_depth_comes_nearer_to_the_truth(shared_data: Path) -> None:
    """The motorcycle's depth made 4 times smaller and soft, as a phone's is: at the edges the error falls by a third at least."""
    folder = shared_data / "rgbd"
    photo = read_image(folder / "motorcycle_left.png")
    settings = DepthSettings(stereo=StereoCalibration(994.978, 0.193001, 31.086))
    truth = open_depth(folder / "motorcycle_disp.npz", photo, settings)
    height, width = truth.depth_m.shape
    soft = cv2.resize(cv2.GaussianBlur(truth.dioptres, (0, 0), 3.2), (width // 4, height // 4), interpolation=cv2.INTER_AREA)
    window = np.ones((9, 9), np.uint8)
    edges = (cv2.dilate(truth.dioptres, window) - cv2.erode(truth.dioptres, window) > 0.05) & truth.valid
    plain = np.abs(cv2.resize(soft, (width, height)) - truth.dioptres)
    refined = np.abs(refined_dioptres(soft, photo) - truth.dioptres)
    assert refined[edges].mean() < 0.72 * plain[edges].mean()
    assert refined[~edges & truth.valid].mean() < 1.02 * plain[~edges & truth.valid].mean()


# ---- edges


def soft_card(shrink: int, blur_px: float, shift_px: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A photograph (96x128) of a card at 1 m before a wall at 4 m, the true dioptres, and a small soft map whose edges are off."""
    rng = np.random.default_rng(1)
    inside = np.zeros((96, 128), bool)
    inside[24:72, 40:88] = True
    colour = np.where(inside[..., None], np.array([0.6, 0.15, 0.1]), np.array([0.1, 0.3, 0.5])) * rng.uniform(0.85, 1.15, (96, 128, 1))
    true = np.where(inside, 1.0, 0.25).astype(np.float32)
    moved = np.roll(true, shift_px, axis=1)
    soft = cv2.GaussianBlur(moved, (0, 0), blur_px) if blur_px else moved
    return srgb_to_linear(colour.astype(np.float32)), true, cv2.resize(soft, (128 // shrink, 96 // shrink), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(("shrink", "blur_px", "shift_px", "edge_px"), [(1, 1.5, 0, 5), (2, 2.0, 0, 3), (4, 3.0, 0, 3), (4, 2.0, 2, 3)])
def test_no_depth_floats_between_card_and_wall(shrink: int, blur_px: float, shift_px: int, edge_px: int) -> None:
    """edge_px: three standard deviations of the softness, in pixels of the small map."""
    photo, true, soft = soft_card(shrink, blur_px, shift_px)
    refined = refined_dioptres(soft, photo, edge_px)
    floating = (np.abs(refined - 1.0) > 0.04) & (np.abs(refined - 0.25) > 0.04)
    assert floating.mean() < 0.002
    plain = cv2.resize(soft, (128, 96))
    assert ((np.abs(plain - 1.0) > 0.04) & (np.abs(plain - 0.25) > 0.04)).mean() > 0.02
    wrong = np.abs(refined - true) > 0.3
    window = np.ones((5, 5), np.uint8)
    beyond_a_pixel = wrong & (cv2.dilate(true, window) == cv2.erode(true, window))
    assert wrong.mean() < 0.002 and beyond_a_pixel.mean() < 0.0005


def test_a_slanted_floor_and_a_wire_survive() -> None:
    floor = np.broadcast_to(np.linspace(0.2, 1.5, 48, dtype=np.float32)[:, None], (48, 64)).copy()
    photo = np.random.default_rng(2).uniform(0, 1, (96, 128, 3)).astype(np.float32)
    refined = refined_dioptres(floor, photo)
    np.testing.assert_allclose(refined, cv2.resize(floor, (128, 96)), atol=1e-6)
    # One pixel of the map wide, before a far wall: snapping must not take its rim for an edge without a near side.
    photo = np.full((96, 128, 3), 0.3, np.float32)
    photo[:, 60:64] = 0.02
    small = np.full((48, 64), 0.25, np.float32)
    small[:, 30:32] = 1.0
    refined = refined_dioptres(small, photo)
    assert (refined[10:-10, 60:64] > 0.9).mean() > 0.95 and (refined[10:-10, :56] < 0.3).all()


def test_guided_upsampling_is_exact_where_values_are_linear_in_colour() -> None:
    """With epsilon to 0 and values = a . colour + b in the whole picture, the filter gives just that (He et al. 2013, Eq. 13)."""
    guide = np.random.default_rng(3).uniform(0, 1, (32, 40, 3)).astype(np.float32)
    values = (guide @ np.array([0.5, -0.2, 0.3], np.float32) + 0.1).astype(np.float32)
    np.testing.assert_allclose(guided_upsampling(values, guide, 3, 1e-7), values, atol=2e-4)


# ---- phones


def jpeg_with_depth(
    path: Path, level: np.ndarray, kind: str = "RangeInverse", drop_chunk: bool = False, orientation: int | None = None
) -> Path:
    """A JPEG whose extended XMP, in chunks out of order, holds GDepth and GImage; written from the specification."""
    original = base64.b64encode(cv2.imencode(".png", np.full((24, 32, 3), 128, np.uint8))[1].tobytes()).decode()
    depth = base64.b64encode(cv2.imencode(".png", level)[1].tobytes()).decode()
    names = 'xmlns:GImage="http://ns.google.com/photos/1.0/image/" xmlns:GDepth="http://ns.google.com/photos/1.0/depthmap/"'
    rdf = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">{}</rdf:RDF></x:xmpmeta>'
    extended = rdf.format(f'<rdf:Description {names} GDepth:Data="{depth}" GImage:Data="{original}"/>').encode()
    digest = hashlib.md5(extended).hexdigest().upper()
    packet = rdf.format(
        f'<rdf:Description {names} xmlns:GFocus="http://ns.google.com/photos/1.0/focus/" xmlns:xmpNote="http://ns.adobe.com/xmp/note/" '
        f'GDepth:Format="{kind}" GDepth:Near="0.5" GDepth:Far="4" GDepth:Mime="image/png" xmpNote:HasExtendedXMP="{digest}" '
        f'GFocus:FocalDistance="1.5" GFocus:BlurAtInfinity="0.01"/>'
    ).encode()
    segments = [b"http://ns.adobe.com/xap/1.0/\0" + packet]
    step = len(extended) // 3 + 1
    chunks = [
        b"http://ns.adobe.com/xmp/extension/\0"
        + digest.encode()
        + len(extended).to_bytes(4, "big")
        + offset.to_bytes(4, "big")
        + extended[offset : offset + step]
        for offset in range(0, len(extended), step)
    ]
    segments += [chunks[2], chunks[0], *([] if drop_chunk else [chunks[1]])]
    head = b"".join(b"\xff\xe1" + (len(each) + 2).to_bytes(2, "big") + each for each in segments)
    # A TIFF header with the one tag 0x0112, a short.
    exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([orientation or 1]) + b"\0\0\0\0\0\0"
    head = (b"" if orientation is None else b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif) + head
    plain = cv2.imencode(".jpg", np.full((24, 32, 3), 90, np.uint8))[1].tobytes()
    path.write_bytes(plain[:2] + head + plain[2:])
    return path


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        # d = far near / (far - n (far - near)), n = 0.4: 4 * 0.5 / (4 - 0.4 * 3.5) = 0.76923 m
        ("RangeInverse", 0.76923),
        # d = near + n (far - near) = 0.5 + 0.4 * 3.5
        ("RangeLinear", 1.9),
    ],
)
def test_gdepth_formats(tmp_path: Path, kind: str, expected: float) -> None:
    phone = read_phone_photo(jpeg_with_depth(tmp_path / "p.jpg", np.full((24, 32), 102, np.uint8), kind))
    assert phone is not None and phone.focus is not None and phone.original_rgb is not None
    np.testing.assert_allclose(phone.depth.depth_m, expected, rtol=1e-4)
    np.testing.assert_allclose(linear_to_srgb(phone.original_rgb), 128 / 255, atol=1e-5)
    assert phone.focus.focus_distance_m == 1.5
    # A radius of 0.01 of the longer side of 32 px is a diameter of 0.64 px at infinity, 1/1.5 dioptres away.
    assert phone.focus.coc_px_per_dioptre(32, 24) / 1.5 == pytest.approx(0.64)


def test_a_phone_held_upright_gives_upright_depth(tmp_path: Path) -> None:
    """Exif 6: the stored top row is the right column of the upright picture."""
    level = np.zeros((24, 32), np.uint8)
    level[0] = 255
    phone = read_phone_photo(jpeg_with_depth(tmp_path / "p.jpg", level, orientation=6))
    assert phone is not None and phone.original_rgb is not None
    assert phone.depth.depth_m.shape == phone.depth.valid.shape == phone.original_rgb.shape[:2] == (32, 24)
    np.testing.assert_allclose(phone.depth.depth_m[:, -1], 4.0, rtol=1e-6)
    np.testing.assert_allclose(phone.depth.depth_m[:, :-1], 0.5, rtol=1e-6)
    path = jpeg_with_depth(tmp_path / "q.jpg", np.zeros((24, 32), np.uint8))
    assert open_depth(path, GREY, DepthSettings(near_far_m=(2.0, 8.0))).depth_m == pytest.approx(2.0), "the user's range comes first"


def test_damaged_phone_files_say_so(tmp_path: Path) -> None:
    level = np.zeros((24, 32), np.uint8)
    for changed, said in (({"drop_chunk": True}, "incomplete"), ({"kind": "Other"}, "RangeInverse or RangeLinear")):
        refused(said, read_phone_photo, jpeg_with_depth(tmp_path / "a.jpg", level, **changed))
    plain = tmp_path / "plain.jpg"
    plain.write_bytes(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    assert read_phone_photo(plain) is None


def test_a_real_phone_photograph_blurred_as_the_phone_says_is_what_the_phone_made(shared_data: Path) -> None:
    """Lens Blur: our render of its sharp original with its depth and its blur (a radius over the longer side) comes nearest to its own
    result, nearer than with half or twice the blur, and far nearer than the original is.
    """
    path = shared_data / "rgbd" / "phone_lens_blur_gdepth.jpg"
    phone, shown = read_phone_photo(path), linear_to_srgb(half_size(read_image(path)))
    assert phone is not None and phone.focus is not None and phone.original_rgb is not None
    assert phone.depth.depth_m.min() == pytest.approx(14.915 / 12.4236, rel=5e-3), "a step of its 8 bits is 0.46 % there"
    height, width = shown.shape[:2]
    wanted = phone.focus.coc_px_per_dioptre(width, height)
    wide_open = Lens(50.0, 1.0, phone.focus.focus_distance_m, 36.0)
    sharp = opaque(half_size(phone.original_rgb), np.ascontiguousarray(phone.depth.depth_m[::2, ::2]))

    def likeness_db(factor: float) -> float:
        lens = replace(wide_open, f_number=wide_open.coc_px_per_dioptre(width) / (factor * wanted))
        return psnr(linear_to_srgb(PolygonDifferences(threads=1).render([sharp], lens).rgb), shown)

    found = {factor: likeness_db(factor) for factor in (0.5, 1.0, 2.0)}
    assert found[1.0] > 27.0 and found[1.0] > max(found[0.5], found[2.0]) + 2.0
    assert found[1.0] > psnr(linear_to_srgb(sharp.rgb), shown) + 7.0


def half_size(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(rgb, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32)


def test_a_slope_in_8_bit_has_no_terraces_and_an_edge_stays() -> None:
    """A slope of 40 steps over 400 px falls into terraces of 10 px; an edge of 100 steps lies in the middle of it."""
    rows = np.linspace(100.0, 140.0, 400, dtype=np.float32)[None] + np.where(np.arange(400) < 200, 0.0, 100.0)[None].astype(np.float32)
    truth = np.repeat(rows, 50, axis=0) / np.float32(255.0)
    stored = np.round(255.0 * truth) / np.float32(255.0)
    found = without_steps(stored.astype(np.float32), 256)
    away = np.s_[:, np.r_[20:180, 220:380]]
    # Rounding is off by 0.29 of a step (rms) and jumps by whole ones; the slope itself rises by 0.1 of a step from pixel to pixel.
    assert np.sqrt(np.square(found - truth)[away].mean()) * 255.0 < 0.1 and np.abs(found - stored).max() * 255.0 <= 1.001
    assert np.abs(np.diff(found, axis=1))[away].max() * 255.0 < 0.15
    assert (np.diff(found[25, 199:201]) * 255.0).min() > 97.0, "the edge loses a step on each side at most"
    assert without_steps(stored, 65536) is stored


@pytest.mark.parametrize("names", ["Z", "Y", "RGB"])
def test_an_exr_of_plain_numbers_is_put_in_metres_by_its_range(tmp_path: Path, names: str) -> None:
    """Renderers normalise Z, and node trees invert it: the largest number is NEAR, even steps of 1/distance."""
    numbers = np.linspace(0.0, 1.0, 12, dtype=np.float32).reshape(3, 4)
    write_exr(tmp_path / "z.exr", ExrPart(dict.fromkeys(names, numbers)))
    expected = 1.0 / (1.0 / 8.0 + numbers * (1.0 / 0.5 - 1.0 / 8.0))
    np.testing.assert_allclose(depth_of_file(tmp_path / "z.exr", (0.5, 8.0)), expected, rtol=1e-5)
    found = open_depth(tmp_path / "z.exr", GREY[:3, :4], DepthSettings((0.5, 8.0), exact=True))
    np.testing.assert_allclose(found.depth_m, expected, rtol=1e-5)
    found = open_depth(tmp_path / "z.exr", GREY[:3, :4], DepthSettings(metres_per_unit=10.0, exact=True))
    np.testing.assert_allclose(found.depth_m[found.valid], 10.0 * numbers[numbers > 0])


def test_an_exr_without_one_channel_of_depth_is_no_metres(tmp_path: Path) -> None:
    """A picture in black and white, whose numbers are light unless the user says that they are not, and two layers of a renderer."""
    numbers = np.linspace(0.1, 1.0, 12, dtype=np.float32).reshape(3, 4)
    write_exr(tmp_path / "grey.exr", ExrPart(dict.fromkeys("RGB", numbers)))
    refused("but it has B, G, R: write it as Z", read_depth, tmp_path / "grey.exr")
    write_exr(tmp_path / "two.exr", ExrPart(dict.fromkeys(["A.Depth.Z", "B.Depth.Z"], numbers)))
    refused("one channel of depth, but it has A.Depth.Z and B.Depth.Z: write the one", read_depth, tmp_path / "two.exr")
    write_exr(tmp_path / "one.exr", ExrPart({"A.Depth.Z": numbers}))
    np.testing.assert_array_equal(read_depth(tmp_path / "one.exr"), numbers)
