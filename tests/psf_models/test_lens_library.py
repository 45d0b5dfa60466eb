"""The lens library: prescriptions against their patents, descriptions against rays traced here, and names wherever a lens is asked for."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.image_io import read_image, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import net_area
from mrbokeh.optics.lens_file import read_lens, write_lens
from mrbokeh.optics.lens_library import FOLDER, facts, names, shipped
from mrbokeh.psf_models import lens_description
from mrbokeh.psf_models.lens_description import FOCUS_IN_FOCAL_LENGTHS, Bench, TracedLight, misplaced_light
from mrbokeh.psf_models.physical_lens import PhysicalLens, read_prescription
from mrbokeh.renderers.choose import files_of, lens_and_renderer
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh

HALF_DIAGONAL_MM = 0.5 * math.hypot(36.0, 24.0)
CORNER = (1.0, 0.0)


@pytest.mark.parametrize("name", names())
def test_prescriptions_have_the_focal_length_and_f_number_of_their_patents(name: str) -> None:
    """Stated: what the patent promises, scaled with its surfaces; only rounding differs, of old tables and f-numbers (2.8 for 2.89).

    Paraxial: without the tracer. A lens gathers its axial beam in a point small against the blur it is made for.
    """
    lens, file = read_prescription(name), json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    stated, described = file["prescription"], read_lens(name)
    assert lens.focal_length_mm == pytest.approx(stated["stated_focal_length_mm"], rel=0.02)
    assert stated["stated_f_number"] is None or lens.f_number == pytest.approx(stated["stated_f_number"], rel=0.035)
    assert (described.focal_length_mm, described.f_number) == pytest.approx((lens.focal_length_mm, lens.f_number), rel=1e-3)
    assert stated["patent"] and stated["inventors"] and 1840 < stated["year"] < 2005 and stated["source"]
    assert (FOLDER / f"{name}.json").stat().st_size < 4096


def test_there_are_lenses_for_what_people_ask_for() -> None:
    lengths_mm = [facts(name)["focal_length_mm"] for name in names()]
    assert len(lengths_mm) >= 10 and min(lengths_mm) < 30 and max(lengths_mm) > 190
    for at_mm in (35, 50, 58, 85, 100, 135):
        assert any(each == pytest.approx(at_mm, rel=0.02) for each in lengths_mm)


def passed(name: str, angle_rad: float) -> np.ndarray:
    """Positions (x, y) across the axis, before the lens, of even parallel rays that come through; x points to where they come from.

    Written anew: each ray meets each sphere where |p + t d - c| = R, and is bent by Snell's law with the index of the d line.
    """
    surfaces = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))["prescription"]["surfaces"]
    half_mm = surfaces[0][4]
    across = np.linspace(-half_mm, half_mm, 161)
    x, y = (each.ravel() for each in np.meshgrid(across, across))
    start = np.stack([x, y, np.full_like(x, -30.0)], axis=1)
    start[:, 0] += 30.0 * math.tan(angle_rad)
    points, rays = start.copy(), np.tile([-math.sin(angle_rad), 0.0, math.cos(angle_rad)], (len(x), 1))
    open_, at_mm, index = np.ones(len(x), bool), 0.0, 1.0
    for radius_or_flat, distance_mm, behind, _, diameter_mm in surfaces:
        radius_mm = 1e6 if radius_or_flat is None else radius_or_flat
        if radius_mm == 0.0:  # the iris
            step = (at_mm - points[:, 2]) / rays[:, 2]
            points = points + step[:, None] * rays
        else:
            centre = np.array([0.0, 0.0, at_mm + radius_mm])
            along = ((centre - points) * rays).sum(axis=1)
            square = along**2 - ((centre - points) ** 2).sum(axis=1) + radius_mm**2
            open_ &= square > 0.0
            step = along - math.copysign(1.0, radius_mm) * np.sqrt(np.maximum(square, 0.0))
            points = points + step[:, None] * rays
            normal = (centre - points) / radius_mm  # towards +z at the vertex
            cosine = (normal * rays).sum(axis=1)
            beyond = 1.0 - (index / behind) ** 2 * (1.0 - cosine**2)
            open_ &= beyond > 0.0
            rays = index / behind * rays + (np.sqrt(np.maximum(beyond, 0.0)) - index / behind * cosine)[:, None] * normal
        open_ &= np.hypot(points[:, 0], points[:, 1]) <= 0.5 * diameter_mm
        points[~open_], rays[~open_] = (0.0, 0.0, at_mm), (0.0, 0.0, 1.0)
        at_mm, index = at_mm + distance_mm, behind
    return np.stack([x, y], axis=1)[open_]


@pytest.mark.parametrize("name", ["portrait-85", "portrait-100", "portrait-135", "sonnar-180"])
def test_cat_eyes_are_those_of_rays_traced_by_another_program(name: str) -> None:
    """The share of the pupil that is open in the corner, and its shape: narrow towards the middle of the frame, as high across.

    The rays here are parallel, the description is of a lens focused at 40 focal lengths and allows for aberrations: a tenth of the pupil.
    """
    lens, angle_rad = read_lens(name), math.atan(HALF_DIAGONAL_MM / read_lens(name).focal_length_mm)
    axis, corner = passed(name, 0.0), passed(name, angle_rad)
    plain = replace(lens.aperture, spherical_aberration=0.0).seen(1, CORNER, None)
    open_share = net_area((plain.outlines, plain.weights)) / math.pi
    assert open_share < 0.9
    assert open_share == pytest.approx(len(corner) * math.cos(angle_rad) / len(axis), abs=0.12)
    described = np.ptp(np.concatenate(plain.outlines), axis=0) / 2.0
    traced = np.ptp(corner, axis=0) / np.ptp(axis, axis=0)
    assert described[0] < described[1] and traced[0] < traced[1]
    np.testing.assert_allclose(described, traced, atol=0.16)


def test_descriptions_beat_a_disc_where_they_were_not_fitted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By half for this lens, at a place and depth between those of the fit; a fit of few steps is on its way there."""
    prescription, kept = read_prescription("portrait-135"), read_lens("portrait-135")
    focus_m = FOCUS_IN_FOCAL_LENGTHS * prescription.focal_length_mm / 1000.0
    light = Bench(prescription, focus_m, HALF_DIAGONAL_MM).light(3.0 * focus_m, 0.85)
    disc = replace(kept, aperture=Aperture.disc(), petzval_radius_mm=math.inf)
    assert misplaced_light(kept, light) < 0.5 * misplaced_light(disc, light)
    monkeypatch.setattr(lens_description, "_EVALUATIONS", 60)
    done = mrbokeh("lens", "describe", "portrait-135", "--blades", 9, "--out", tmp_path / "lens.json")
    assert done.returncode == 0 and "135 mm f/2; it misplaces" in done.stdout, done.stderr
    made = read_lens(tmp_path / "lens.json")
    assert misplaced_light(made, light) < 0.7 * misplaced_light(disc, light)
    assert (made.focal_length_mm, made.widest_f_number, made.aperture.iris_blades) == (kept.focal_length_mm, kept.widest_f_number, 9)


def test_the_sharpest_focus_is_sharper_than_the_paraxial_one() -> None:
    """Mean radius of green light on the axis of the f/1.4 lens, by kernels: three times smaller where a photographer focuses."""
    spots_px = []
    for sharpest in (False, True):
        model = PhysicalLens("fast-50", focus_distance_m=2.0, image_width_px=7200, nearest_m=1.0, farthest_m=10.0, sharpest=sharpest)
        kernel = model.kernel(np.array([[2.0, 2.0], [0.0, 0.0]]), 1 << 12, 0)[..., 1]
        y, x = np.indices(kernel.shape) - len(kernel) // 2
        spots_px.append(float((np.hypot(x, y) * kernel).sum() / kernel.sum()))
        assert ("sharpest" in model.settings) is sharpest
    assert spots_px[1] < spots_px[0] / 3.0


@pytest.mark.parametrize("name", ["sonnar-50", "primoplan-58", "portrait-85", "tele-300"])
def test_the_sharpest_place_lies_within_the_search(name: str) -> None:
    """The place, looked for in steps of 0.0075 mm and f-numbers, is no end of the search."""
    lens = read_prescription(name)
    bench = Bench(lens, FOCUS_IN_FOCAL_LENGTHS * lens.focal_length_mm / 1000.0, HALF_DIAGONAL_MM)
    assert abs(bench.focus_shift_mm) < 0.9 * lens_description._FOCUS_SEARCH * lens.f_number


@pytest.mark.parametrize(
    "damaged", [{"prescription": 5}, {"prescription": {"surfaces": [1, 2]}}, {"prescription": {"surfaces": 7}}, [], {}]
)
def test_a_lens_file_without_surfaces_is_told(tmp_path: Path, damaged: object) -> None:
    (tmp_path / "lens.json").write_text(json.dumps(damaged))
    with pytest.raises(InputError, match="the surfaces of a prescription"):
        read_prescription(tmp_path / "lens.json")


@pytest.mark.parametrize(
    ("option", "why"),
    [
        ("--blades=2", "iris_blades from 3"),
        ("--sensor-width=450", "from 2 to 400 mm"),
        ("--sensor-width=nan", "expected millimetres above 0"),
    ],
)
def test_describe_refuses_before_it_traces(tmp_path: Path, option: str, why: str) -> None:
    done = mrbokeh("lens", "describe", "biotar-58", option, "--out", tmp_path / "lens.json")
    assert done.returncode == 2 and why in done.stderr and not (tmp_path / "lens.json").exists(), done.stderr


def test_a_lens_that_is_described_closed_is_not_opened_again(tmp_path: Path) -> None:
    """What its opening was is not in the file: blades, rims and bright rims of the closed one say nothing of it."""
    write_lens(tmp_path / "closed.json", read_lens("biotar-58").stating({"f_number": 5.6}))
    closed = read_lens(tmp_path / "closed.json")
    assert closed.stating({"f_number": 8.0}).f_number == 8.0
    with pytest.raises(InputError, match=r"described as closed to f/5\.6"):
        closed.stating({"f_number": 1.8})


def test_light_of_an_ideal_lens_is_all_in_its_place() -> None:
    """Even rays over the unit disc: what is left is their grain on the kernel's pixels, and the rim's polygon."""
    rng = np.random.default_rng(0)
    radius, angle = np.sqrt(rng.uniform(0.0, 1.0, 200_000)), rng.uniform(0.0, math.pi, 200_000)
    u = np.repeat(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)[:, None], 3, axis=1)
    light = TracedLight(0.0, 1.0, u, np.ones(u.shape[:2]))
    assert light.radii == pytest.approx([math.sqrt(0.5)] * 3, rel=5e-3)
    plain = replace(read_lens("fast-50"), aperture=Aperture.disc(), petzval_radius_mm=math.inf)
    assert misplaced_light(plain, light) < 0.04


def test_a_closed_iris_shows_its_blades_and_no_cat_eyes() -> None:
    """At f/8, a quarter of the pupil of f/2, no rim of this lens is in the way; what it was stays while it is open."""
    lens = read_lens("portrait-135")
    assert lens.stating({"focus_distance_m": 3.0}).aperture is lens.aperture
    closed = lens.stating({"f_number": 8.0})
    assert closed.aperture.seen(1, CORNER, None).outlines[0].shape == (9, 2)
    assert closed.aperture.spherical_aberration == pytest.approx(lens.aperture.spherical_aberration / 16.0, rel=0.01)
    small = lens.stating({"sensor_width_mm": 18.0})
    assert [rim[0] for rim in small.aperture.rims] == pytest.approx([0.5 * rim[0] for rim in lens.aperture.rims])
    with pytest.raises(InputError, match=r"the lens opens to f/2: expected an f-number of at least that, got 1\.4"):
        lens.stating({"f_number": 1.4})
    # A lens marked f/1.4 that opens to f/1.44 is fully open there.
    assert read_lens("biotar-58").stating({"f_number": 1.4}).f_number == read_lens("biotar-58").f_number


def test_every_name_is_a_lens_and_what_is_in_the_folder_goes_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in names():
        lens, _ = lens_and_renderer(Path(name), None)
        assert lens is not None and lens.widest_f_number == lens.f_number and lens.aperture.rims
        assert files_of(Path(name)) == [FOLDER / f"{name}.json"]
    assert shipped(tmp_path / "scenes" / "biotar-58") == FOLDER / "biotar-58.json"  # as a scene file beside it names one
    write_lens(tmp_path / "biotar-58", read_lens("tessar-50"))
    assert shipped("biotar-58") == Path("biotar-58") and read_lens("biotar-58").focal_length_mm == 50.0
    with pytest.raises(InputError, match=r"such as biotar-58, .*, got 'biotar-85': `mrbokeh lens list` shows all"):
        read_lens("biotar-85")


def test_commands_take_a_name(tmp_path: Path) -> None:
    write_image(tmp_path / "sharp.exr", np.pad(np.full((2, 2, 3), 50.0, np.float32), ((11, 11), (17, 17), (0, 0))), half=False)
    sharp = ("--rgb", tmp_path / "sharp.exr", "--depth", "30", "--renderer", "scatter")
    done = mrbokeh("render", *sharp, "--lens", "summicron-50", "--focus", 3, "--out", tmp_path / "a.exr")
    assert done.returncode == 0 and "50.01 mm f/2 focused at 3 m" in done.stdout, done.stderr
    assert read_image(tmp_path / "a.exr").sum() > 0.0
    alpha = np.zeros((24, 36), np.float32)
    alpha[8:16, 10:20] = 1.0
    write_layer(
        tmp_path / "card.exr", Layer(alpha[..., None] * np.ones(3, np.float32), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    )
    out = (
        "--layer",
        tmp_path / "card.exr",
        "--lens",
        "double-gauss-50",
        "--f-number",
        4,
        "--renderer",
        "scatter",
        "--out",
        tmp_path / "b.exr",
    )
    done = mrbokeh("composite", tmp_path / "sharp.exr", *out)
    assert done.returncode == 0 and (tmp_path / "b.exr").is_file(), done.stderr
    listed = mrbokeh("lens", "list", "--json")
    told = json.loads(listed.stdout)["figures"]["lenses"]
    assert [each["name"] for each in told] == names() and all("surfaces" not in each for each in told)
    done = mrbokeh("lens", "psf", "physical", "--prescription", "petzval-20", "--out", tmp_path / "bank")
    assert done.returncode == 2 and "petzval-100" in done.stderr
