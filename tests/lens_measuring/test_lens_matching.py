"""Lenses matched to photographs made through known ones: blades, curvature, rotation, squeeze and cat-eye come out as they went in."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from shapely import Polygon
from typer.testing import CliRunner

from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from mrbokeh.cli import main
from mrbokeh.commands.lens import app
from mrbokeh.images.color import linear_to_srgb, srgb_to_linear
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.images.layer import opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.lens_measuring.matching.discs import Disc, find_discs
from mrbokeh.lens_measuring.matching.lens_match import LensMatch, depth_from_size, effective_f_number, focus_from_size, match_lens
from mrbokeh.lens_measuring.matching.match_report import table_of
from mrbokeh.lens_measuring.matching.outline_fit import BladedOpening, fit_outlines, outline_radius
from mrbokeh.lens_measuring.matching.photo_facts import PhotoFacts, read_facts
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.photograph import full_value, read_photograph
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

HEIGHT, WIDTH = 214, 320
LENS = Lens(50.0, 1.8, 1.0, 14.0)
COC_PX, COUNT = 26.0, 14
FACTS = PhotoFacts(50.0, 1.8, 14.0, 1.0)
DARK = 0.02
DISC, HEPTAGON = Aperture.disc(), Aperture.blades(7, np.radians(12.0))


@lru_cache
def places(count: int) -> tuple[tuple[int, int], ...]:
    """Pixels (row, column) of lights that stand apart from each other and the border, the same ones always."""
    rng, found = np.random.default_rng(3), []
    for _ in range(4000):
        row, column = int(rng.uniform(18, HEIGHT - 18)), int(rng.uniform(18, WIDTH - 18))
        if all(np.hypot(row - y, column - x) > 1.25 * COC_PX for y, x in found):
            found.append((row, column))
    assert len(found) >= count
    return tuple(found[:count])


def lit_depth_m(side: int) -> float:
    return 1.0 / (1.0 - side * COC_PX / LENS.coc_px_per_dioptre(WIDTH))


@lru_cache
def lights(aperture: Aperture, side: int) -> np.ndarray:
    """Discs of lights of differing brightness through `LENS` with this aperture."""
    rng = np.random.default_rng(5)
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for row, column in places(COUNT):
        rgb[row, column] = rng.uniform(0.5, 3.0) * np.array([1.0, 0.8, 0.6])
    depth_m = np.full((HEIGHT, WIDTH), lit_depth_m(side), np.float32)
    renderer = ScatterReference(Layering(slices=1, field_cells=(9, 7)))
    return renderer.render([opaque(rgb, depth_m)], replace(LENS, aperture=aperture)).rgb


@lru_cache
def photograph(aperture: Aperture, side: int = 1, brightness: float = 300.0, count: int = COUNT) -> np.ndarray:
    """The first lights in the dark, with 1 % of noise, as 8-bit sRGB; most are full."""
    rng, lit = np.random.default_rng(6), np.zeros((HEIGHT, WIDTH), np.uint8)
    for row, column in places(count):
        cv2.circle(lit, (column, row), round(0.62 * COC_PX), 1, -1)
    blurred = DARK + brightness * lit[..., None] * lights(aperture, side)
    noisy = blurred * (1.0 + 0.01 * rng.standard_normal(blurred.shape))
    return np.round(linear_to_srgb(np.clip(noisy, 0.0, 1.0).astype(np.float32)) * 255.0).astype(np.uint8)


def linear(pixels: np.ndarray) -> np.ndarray:
    return srgb_to_linear((pixels / np.float32(255.0)).astype(np.float32))


def matched(aperture: Aperture, side: int = 1, brightness: float = 300.0) -> LensMatch:
    return match_lens(linear(photograph(aperture, side, brightness)), FACTS, side=side, largest_value=1.0)


def turn_apart_deg(angle_rad: float, wanted_deg: float, blades: int) -> float:
    """Between rotations of a regular polygon."""
    period = 360.0 / blades
    return abs((np.degrees(angle_rad) - wanted_deg + 0.5 * period) % period - 0.5 * period)


# --- the lenses of the brief ---


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.slow
def test_heptagon_turned_by_12_degrees(side: int) -> None:
    opening = matched(HEPTAGON, side).choice.fit.opening
    assert opening.blades == 7
    assert turn_apart_deg(opening.rotation_rad, 12.0, 7) < 1.0
    assert opening.curvature == pytest.approx(0.0, abs=0.1)
    assert opening.squeeze == pytest.approx(1.0, rel=0.02) and opening.cat_eye == pytest.approx(0.0, abs=0.05)


@pytest.mark.slow
def test_nine_curved_blades_and_a_heptagon_seen_from_the_wrong_side() -> None:
    """180 is 25.7 degrees more than whole sevenths of a turn; what an odd number of blades shows does not tell the side by itself."""
    picture = linear(photograph(HEPTAGON, side=-1))
    opening = match_lens(picture, FACTS, side=1, largest_value=1.0).choice.fit.opening
    assert opening.blades == 7 and turn_apart_deg(opening.rotation_rad, 12.0 + 180.0, 7) < 1.0
    found = matched(Aperture.blades(9, 0.2, 0.5))
    opening, errors = found.choice.fit.opening, found.choice.fit.errors
    assert opening.blades == 9
    assert opening.curvature == pytest.approx(0.5, abs=0.1)
    assert turn_apart_deg(opening.rotation_rad, np.degrees(0.2), 9) < 2.0
    assert 0.0 < errors["curvature"] < 0.1 and 0.0 < np.degrees(errors["rotation_rad"]) < 2.0


@pytest.mark.slow
def test_a_round_opening_has_no_blades_and_its_discs_are_found_where_they_are() -> None:
    found = matched(DISC)
    discs, wanted = find_discs(linear(photograph(DISC)).max(axis=2), 1.0), np.array(places(COUNT))[:, ::-1] + 0.5
    assert len(discs) == len(wanted)
    assert all(np.hypot(*(wanted - disc.centroid_px).T).min() < 0.1 for disc in discs)
    opening = found.choice.fit.opening
    assert opening.blades == 0
    assert opening.squeeze == pytest.approx(1.0, rel=0.02) and opening.cat_eye == pytest.approx(0.0, abs=0.05)
    assert float(np.median(found.own[:, 2])) == pytest.approx(0.5 * COC_PX, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("aperture", "squeeze", "cat_eye"), [(replace(DISC, cat_eye=0.6), 1.0, 0.6), (Aperture.disc().squeezed(1.33), 1.33, 0.0)]
)
def test_cat_eyes_and_anamorphic_squeeze(aperture: Aperture, squeeze: float, cat_eye: float) -> None:
    opening = matched(aperture).choice.fit.opening
    assert opening.blades == 0
    assert opening.squeeze == pytest.approx(squeeze, rel=0.015) and opening.cat_eye == pytest.approx(cat_eye, abs=0.05)


@pytest.mark.parametrize("strength", [-0.4, 0.4])
@pytest.mark.slow
def test_everything_at_once_with_soft_and_bright_rims(strength: float) -> None:
    aperture = Aperture(Aperture.blades(6, 0.3, 0.4).squeezed(1.33).outlines, (1.0,), 0.5, strength)
    found = matched(aperture, brightness=100.0)  # few are full
    opening = found.choice.fit.opening
    assert opening.blades == 6 and turn_apart_deg(opening.rotation_rad, np.degrees(0.3), 6) < 2.0
    assert opening.curvature == pytest.approx(0.4, abs=0.1)
    assert opening.squeeze == pytest.approx(1.33, rel=0.03)
    assert opening.cat_eye == pytest.approx(0.5, abs=0.1)
    assert found.lens.aperture.spherical_aberration == pytest.approx(strength, abs=0.1)


def test_full_discs_tell_no_rim_and_lights_in_the_middle_no_cat_eye() -> None:
    found = matched(DISC, brightness=3000.0)
    assert found.rim is None and found.lens.aperture.spherical_aberration == 0.0
    assert any(row.name == "spherical aberration" and row.value == "not known" for row in table_of(found))
    # Within 0.07 half diagonals even a rim 0.6 pupil radii off in the corner cuts only 0.2 px off discs of 11 px.
    grey = np.full((HEIGHT, WIDTH), DARK, np.float32)
    rows, columns = np.indices(grey.shape) + 0.5
    for x, y in ((160.0, 95.0), (150.0, 113.0), (170.0, 113.0)):
        grey += np.clip(6.0 - np.hypot(columns - x, rows - y), 0.0, 1.0).astype(np.float32)
    found = match_lens(np.repeat(grey[..., None], 3, axis=2), FACTS)
    assert "cat_eye" in found.unknown and found.lens.aperture.cat_eye == 0.0
    assert any(row.name == "cat-eye" and row.value == "not known" for row in table_of(found))


def test_a_heart_is_no_iris_and_gives_its_outline() -> None:
    """In front of the focus, where it shows mirrored.

    Its tip is thinner than a pixel, so that the unit of the outline is shorter: outlines are compared at the same area.
    """
    found = matched(Aperture.heart(), -1)
    assert found.mean is not None and found.choice.is_poor
    ours, heart = (Polygon(outlines[0]) for outlines in (found.lens.aperture.outlines, Aperture.heart().outlines))
    ours = Polygon(np.array(ours.exterior.coords) * np.sqrt(heart.area / ours.area))
    assert ours.intersection(heart).area / ours.union(heart).area > 0.93
    flipped = Polygon(-np.array(ours.exterior.coords))
    assert flipped.intersection(heart).area / flipped.union(heart).area < 0.85
    assert "outline" in [row.value for row in table_of(found)]


# --- sizes ---


@pytest.mark.parametrize(("side", "depth_m"), [(1, 4.0), (1, np.inf), (-1, 0.6)])
def test_sizes_are_coc_px_the_other_way(side: int, depth_m: float) -> None:
    coc_px = float(LENS.coc_px(depth_m, WIDTH))
    assert np.sign(coc_px) == side
    assert focus_from_size(LENS.focused_at(7.0), coc_px, depth_m, WIDTH) == pytest.approx(1.0, rel=1e-9)
    assert effective_f_number(replace(LENS, f_number=2.4), coc_px, depth_m, WIDTH) == pytest.approx(1.8, rel=1e-9)
    assert 1.0 / depth_from_size(LENS, coc_px, WIDTH) == pytest.approx(1.0 / depth_m, abs=1e-9)


def test_focus_and_effective_f_number_of_a_photograph(monkeypatch: pytest.MonkeyPatch) -> None:
    """The edge of full discs lies up to 0.15 px too far out, 1 % of their diameter. Discs and opening do not depend on what is told."""
    picture, depth_m = linear(photograph(DISC)), lit_depth_m(1)
    first = match_lens(picture, FACTS, largest_value=1.0)
    monkeypatch.setattr("mrbokeh.lens_measuring.matching.lens_match.find_discs", lambda *_: list(first.found))
    monkeypatch.setattr("mrbokeh.lens_measuring.matching.lens_match.choose_opening", lambda *_: first.choice)
    focused = match_lens(picture, replace(FACTS, focus_distance_m=None), depth_m=depth_m, largest_value=1.0)
    assert focused.lens.focus_distance_m == pytest.approx(1.0, rel=0.01) and focused.sizes.focus_known
    opened = match_lens(picture, replace(FACTS, f_number=2.2), depth_m=depth_m, largest_value=1.0)
    assert opened.lens.f_number == pytest.approx(1.8, rel=0.015)
    assert abs(opened.lens.f_number - 1.8) < 3.0 * float(opened.sizes.f_number_error or 0.0)
    unknown = match_lens(picture, replace(FACTS, focus_distance_m=None), largest_value=1.0)
    assert not unknown.sizes.focus_known and unknown.lens.focus_distance_m > 1.0  # farther than it is: the lights were taken as far away
    assert "--light-distance" in unknown.sizes.note
    found = match_lens(picture, replace(FACTS, f_number=4.0), largest_value=1.0)
    bound = float(replace(LENS, f_number=4.0).coc_px(np.inf, WIDTH)) * 4.0 / COC_PX
    assert "effective f-number is at most" in found.sizes.note and f"{bound:.2f}"[:3] in found.sizes.note


@pytest.mark.parametrize("times_white", [1.0, 3.0, 100.0])
def test_the_stated_error_of_a_diameter_holds_for_lights_of_any_brightness(times_white: float) -> None:
    """Discs of 22.4 px by their pixels' covered shares; a hundred times white they look 1 px larger."""
    rows, columns = np.mgrid[:240, :320] + 0.5
    picture = np.zeros((240, 320), np.float32)
    for x, y in ((60.3, 50.2), (160.7, 60.6), (250.1, 80.9), (80.5, 170.4), (200.8, 180.1)):
        picture += times_white * np.clip(11.2 + 0.5 - np.hypot(columns - x, rows - y), 0.0, 1.0).astype(np.float32)
    clipped = np.repeat(np.minimum(picture, 1.0)[..., None], 3, axis=2)
    sizes = match_lens(clipped, FACTS, largest_value=1.0).sizes
    assert abs(sizes.diameter_px - 22.4) < 2.0 * sizes.diameter_error_px
    assert sizes.diameter_error_px > 0.45


# --- parts ---


OPENINGS = (
    BladedOpening(0, cat_eye=0.5), BladedOpening(7, 0.4, 0.0, 1.2, -0.4), BladedOpening(6, 0.1, -0.3),
    BladedOpening(9, 0.2, 0.6, 0.8, 0.3),
)  # fmt: skip


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("opening", OPENINGS)
def test_radius_over_angle_is_that_of_the_aperture(opening: BladedOpening, side: int) -> None:
    """Against the polygons that renderers splat; a circle is one of 64 sides there, which strays by 1.2e-3."""
    field = np.array([[0.5, 0.3]])
    angles = np.linspace(-3.0, 3.0, 61)[None]
    (outline,) = opening.aperture().seen(1, (0.5, 0.3)).outlines
    start, stop = side * outline, side * np.roll(outline, -1, axis=0)
    rays = np.stack([np.cos(angles[0]), np.sin(angles[0])], axis=1)
    cross_start, cross_stop = (rays[:, :1] * each[:, 1] - rays[:, 1:] * each[:, 0] for each in (start, stop))
    share = cross_start / (cross_start - cross_stop + (cross_start == cross_stop))
    along = rays @ start.T + share * (rays @ (stop - start).T)
    met = np.where((cross_start > 0.0) != (cross_stop > 0.0), along, -np.inf).max(axis=1)
    np.testing.assert_allclose(outline_radius(opening, angles, field, side)[0], met, atol=2.5e-3)


def contours_of(opening: BladedOpening, noise_px: float, seed: int) -> list[Disc]:
    """Exact contours with noise, of 12 discs of 10 to 20 px all over the frame."""
    rng, discs = np.random.default_rng(seed), []
    for _ in range(12):
        field, radius, centre = rng.uniform(-0.6, 0.6, 2), float(rng.uniform(5.0, 10.0)), rng.uniform(50.0, 150.0, 2)
        angles = np.sort(rng.uniform(-np.pi, np.pi, (1, 72)))
        length = radius * outline_radius(opening, angles, field[None], 1)[0] + noise_px * rng.standard_normal(72)
        points = centre + length[:, None] * np.stack([np.cos(angles[0]), np.sin(angles[0])], axis=1)
        discs.append(Disc(points, centre + 0.3, 0.9 * radius, 1.0, 0.0, (float(field[0]), float(field[1])), False))
    return discs


def test_exact_contours_give_the_opening_back_and_standard_errors_cover_the_spread() -> None:
    truth = BladedOpening(7, 0.3, 0.3, 1.2, 0.4)
    found = fit_outlines(contours_of(truth, 0.0, 0), BladedOpening(7, 0.2, 0.5, 1.0, 0.3), 1).opening
    for name in ("rotation_rad", "curvature", "squeeze", "cat_eye"):
        assert getattr(found, name) == pytest.approx(getattr(truth, name), abs=2e-3)
    # They hold a bias of the grid of pixels, which these contours lack, and are no more than a few times the spread.
    fits = [fit_outlines(contours_of(truth, 0.3, seed), truth, 1) for seed in range(8)]
    for name in ("rotation_rad", "curvature", "squeeze", "cat_eye"):
        spread = float(np.sqrt(np.mean([(getattr(fit.opening, name) - getattr(truth, name)) ** 2 for fit in fits])))
        stated = float(np.mean([fit.errors[name] for fit in fits]))
        assert 0.5 * spread < stated < 6.0 * spread, name


# --- what is refused ---


def require_refused(rgb: np.ndarray, said: str) -> None:
    refused(said, match_lens, rgb.astype(np.float32), FACTS, largest_value=1.0)


def test_texture_two_discs_and_impossible_sizes_are_refused() -> None:
    noise = np.random.default_rng(0).random((HEIGHT // 2, WIDTH // 2, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    require_refused(noise, "found 0")
    require_refused(((smooth - smooth.min()) / np.ptp(smooth)) ** 4, "bright spots|expected at least 3")
    require_refused(np.full_like(noise, 0.3), "found 0")
    require_refused(linear(photograph(DISC, count=2)), "expected at least 3.*found 2.*night")
    refused("--side", effective_f_number, LENS, -10.0, 4.0, WIDTH)
    refused("--light-distance", focus_from_size, LENS, -2000.0, 4.0, WIDTH)


@pytest.mark.parametrize("name", ["stacks/usb_two_layers/13.jpg", "rgbd/bokehme_3_image.jpg"])
def test_real_photographs_without_discs_are_refused(shared_data: Path, name: str) -> None:
    rgb = read_image(shared_data / name)
    half = cv2.resize(rgb, (rgb.shape[1] // 2, rgb.shape[0] // 2), interpolation=cv2.INTER_AREA)
    require_refused(half, "take a photograph with small bright lights")


# --- metadata ---


def exif_file(path: Path, tags: dict[int, object]) -> Path:
    picture = Image.new("RGB", (60, 40))
    exif = picture.getexif()
    exif.get_ifd(0x8769).update(tags)
    picture.save(path, exif=exif)
    return path


def test_facts_of_exif_and_those_that_are_missing(tmp_path: Path) -> None:
    """60 px at 100 per cm are 6 mm. From the film plane 1.05 m: s + s f / (s - f) with f = 50 mm gives s = 0.99736 m."""
    tags = {0x829D: 1.8, 0x920A: 50.0, 0x9206: 1.05, 0xA20E: 100.0, 0xA210: 3, 0xA002: 60}
    facts = read_facts(exif_file(tmp_path / "a.jpg", tags), (60, 40))
    assert (facts.focal_length_mm, facts.f_number) == (50.0, 1.8)
    assert facts.sensor_width_mm == pytest.approx(6.0)
    assert facts.focus_distance_m == pytest.approx(0.99736, abs=1e-5)
    s = float(facts.focus_distance_m or 0.0)
    assert s + s * 0.05 / (s - 0.05) == pytest.approx(1.05)
    bare = read_facts(exif_file(tmp_path / "bare.jpg", {0x829D: 0.0}), (60, 40))
    assert bare == PhotoFacts()
    with pytest.raises(InputError, match=r"give --focal-length, --sensor-width$"):
        bare.given(f_number=2.0).require("bare.jpg")
    refused("--f-number above 0", bare.given, f_number=-1.0)
    write_image(tmp_path / "a.exr", np.zeros((4, 6, 3), np.float32))
    assert read_facts(tmp_path / "a.exr", (6, 4)) == PhotoFacts()


@pytest.mark.parametrize(
    ("name", "focal_length_mm", "width_mm"), [("canon_450d_4.6m.jpg", 100.0, 22.2), ("nikon_d70_0.45m.jpg", 70.0, 23.7)]
)
def test_facts_of_real_files(shared_data: Path, name: str, focal_length_mm: float, width_mm: float) -> None:
    """Widths by the makers; the focal length for 35 mm film is rounded to whole millimetres."""
    path = shared_data / "exif" / name
    with Image.open(path) as picture:
        facts = read_facts(path, picture.size)
    assert facts.focal_length_mm == focal_length_mm and facts.f_number == 4.5
    assert facts.sensor_width_mm == pytest.approx(width_mm, rel=0.015)


# --- the command ---


def test_the_command_writes_a_lens_and_its_evidence(tmp_path: Path) -> None:
    photo, out, evidence = tmp_path / "night.jpg", tmp_path / "lens.json", tmp_path / "lens.png"
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829D: 1.8, 0x920A: 50.0})
    Image.fromarray(photograph(HEPTAGON)).save(photo, exif=exif, quality=92, subsampling=0)
    given = ["match", str(photo), "--out", str(out), "--evidence", str(evidence), "--light-distance", f"{lit_depth_m(1)}"]
    lacking = CliRunner().invoke(app, given)
    assert isinstance(lacking.exception, InputError) and "give --sensor-width" in str(lacking.exception)
    result = CliRunner().invoke(app, [*given, "--sensor-width", "14"])
    assert result.exit_code == 0, result.exception
    lens = read_lens(out)
    assert (lens.focal_length_mm, lens.f_number, lens.sensor_width_mm) == (50.0, 1.8, 14.0)
    assert lens.focus_distance_m == pytest.approx(1.0, rel=0.02)
    turned, heptagon = Polygon(lens.aperture.outlines[0]), Polygon(HEPTAGON.outlines[0])
    assert turned.intersection(heptagon).area / turned.union(heptagon).area > 0.96
    assert "blades" in result.stdout and "+-" in result.stdout
    picture = cv2.imread(str(evidence))
    assert picture is not None and picture.std() > 10.0
    again = CliRunner().invoke(app, [*given, "--sensor-width", "14"])
    assert isinstance(again.exception, InputError) and "--overwrite" in str(again.exception)


def test_a_raw_file_tells_its_lens_and_which_lights_are_full(tmp_path: Path) -> None:
    sensor, lens = SensorModel(full_well_electrons=0.0, read_noise_electrons=0.0), replace(LENS, sensor_width_mm=14.0)
    light = linear(photograph(HEPTAGON)) * np.float32(4.0)
    write_dng(tmp_path / "night.dng", sensor.quantise(sensor.linear_mosaic(light)), sensor, ShotMetadata(lens))
    result = CliRunner().invoke(app, ["match", str(tmp_path / "night.dng"), "--out", str(tmp_path / "lens.json")])
    assert result.exit_code == 0, result.exception
    found = read_lens(tmp_path / "lens.json")
    opening, truth = (Polygon(each.outlines[0]) for each in (found.aperture, HEPTAGON))
    assert (found.focal_length_mm, found.f_number) == (50.0, 1.8) and opening.intersection(truth).area / opening.union(truth).area > 0.94
    full = full_value(tmp_path / "night.dng")
    discs = find_discs(read_photograph(tmp_path / "night.dng").rgb.max(axis=2), full)
    levels = [each.level for each in discs if each.full]
    assert 2 * len(levels) > len(discs) > len(levels) and levels == pytest.approx([full] * len(levels), rel=1e-3)


def test_mistakes_of_the_user_end_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["mrbokeh", "lens", "match", str(tmp_path / "no.jpg"), "--out", str(tmp_path / "lens.json")]
    for extra, wanted in (([], "no such file"), (["--side", "left"], "--side behind or front"), (["--evidence", "a.gif"], ".png, .pdf")):
        monkeypatch.setattr("sys.argv", [*given, *extra])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 2 and wanted in capsys.readouterr().err
