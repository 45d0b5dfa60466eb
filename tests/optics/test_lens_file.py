"""Lens files: what is written is read again, every key does something, every mistake is named."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json, read_lens, write_lens
from mrbokeh.system.errors import InputError

NIKKOR = Lens(focal_length_mm=35.0, f_number=1.8, focus_distance_m=0.8, sensor_width_mm=35.9)
BODY = {"focal_length_mm": 50, "f_number": 1.8, "focus_distance_m": 2.0, "sensor_width_mm": 36}
EVERYTHING = {
    "shape": "polygon", "blades": 7, "curvature": 0.3, "rotation_deg": 0, "inner": 0.6, "image": "path", "cat_eye": 0.0,
    "spherical_aberration": 0.0, "axial_chromatic": [0, 0, 0], "squeeze": 1.0,
}  # fmt: skip


def aperture_of(**aperture: Any) -> Aperture:
    return lens_from_json(BODY | {"aperture": aperture}).aperture


def same_outlines(a: Aperture, b: Aperture) -> bool:
    return a.weights == b.weights and all(np.allclose(x, y, atol=2e-9, rtol=0) for x, y in zip(a.outlines, b.outlines, strict=True))


@pytest.mark.parametrize("focus_m", [0.8, float("inf")])
def test_lens_file_round_trip(tmp_path: Path, focus_m: float) -> None:
    lens = Lens(35.0, 1.8, focus_m, 35.9, Aperture.blades(7, 0.2))
    write_lens(tmp_path / "lens.json", lens)
    again = read_lens(tmp_path / "lens.json")
    assert (again.focal_length_mm, again.f_number, again.focus_distance_m, again.sensor_width_mm) == (35.0, 1.8, focus_m, 35.9)
    np.testing.assert_allclose(again.aperture.outlines[0], lens.aperture.outlines[0], atol=1e-9)
    assert again.has_flat_focus and again.aperture.is_plain


def test_all_fields_survive_and_the_first_version_is_read_as_ever(tmp_path: Path) -> None:
    modifiers = {"cat_eye": -0.4, "spherical_aberration": 0.3, "axial_chromatic": (0.1, 0.0, -0.1), "lateral_chromatic": (0.0, 0.1, 0.2)}
    lens = replace(NIKKOR, aperture=replace(Aperture.ring(0.5), **modifiers), tilt_rad=(0.1, -0.2), petzval_radius_mm=-70.0)
    write_lens(tmp_path / "lens.json", lens)
    again = read_lens(tmp_path / "lens.json")
    assert again.tilt_rad == pytest.approx(lens.tilt_rad, rel=1e-14) and again.petzval_radius_mm == -70.0
    assert same_outlines(again.aperture, lens.aperture)
    assert all(getattr(again.aperture, name) == value for name, value in modifiers.items())
    outline = [[1, 0], [0, 1], [-1, 0], [0, -1]]
    document = BODY | {"format": "mrbokeh-lens", "version": 1, "focus_distance_m": None}
    document |= {"aperture": {"outlines": [outline], "weights": [1]}}
    lens = lens_from_json(document)
    assert lens.aperture.is_plain and lens.focus_distance_m == np.inf
    assert set(lens_to_json(lens)) == set(document) and set(lens_to_json(lens)["aperture"]) == {"outlines", "weights"}


@pytest.mark.parametrize(
    ("aperture", "expected"),
    [
        ({"shape": "disc"}, Aperture.disc()),
        ({"shape": "polygon", "blades": 7, "curvature": 0.3, "rotation_deg": 30}, Aperture.blades(7, np.pi / 6, 0.3)),
        ({"shape": "ring", "inner": 0.6}, Aperture.ring(0.6)),
        ({"shape": "star", "blades": 5, "inner": 0.4, "rotation_deg": 90}, Aperture.star(5, 0.4, np.pi / 2)),
        ({"shape": "heart", "rotation_deg": -45}, Aperture.heart().rotated(-np.pi / 4)),
        ({"shape": "outline", "points": [[0, 0], [4, 0], [0, 3]]}, Aperture.from_outline("M0 0 4 0 0 3Z")),
        ({"shape": "outline", "path": "M0 0 4 0 0 3Z"}, Aperture.from_outline("M0 0 4 0 0 3Z")),
        ({"shape": "disc", "squeeze": 1.5}, Aperture.disc().squeezed(1.5)),
    ],
)
def test_shapes_by_name(aperture: dict[str, Any], expected: Aperture) -> None:
    assert same_outlines(aperture_of(**aperture), expected)


def test_a_form_filled_in_for_all_shapes_is_taken_as_the_one_it_names() -> None:
    assert same_outlines(aperture_of(**EVERYTHING), Aperture.blades(7, 0.0, 0.3))
    assert same_outlines(aperture_of(**EVERYTHING | {"shape": "disc"}), Aperture.disc())
    assert same_outlines(aperture_of(**EVERYTHING | {"shape": "ring"}), Aperture.ring(0.6))


@pytest.mark.parametrize(
    "changed",
    [
        {"blades": 8}, {"curvature": 0.5}, {"rotation_deg": 10}, {"squeeze": 1.33}, {"cat_eye": 0.5}, {"spherical_aberration": 0.5},
        {"axial_chromatic": [0.1, 0, 0]}, {"lateral_chromatic": [0.1, 0, 0]}, {"shape": "star"}, {"shape": "ring", "inner": 0.5},
    ],
)  # fmt: skip
def test_every_key_of_an_aperture_changes_the_kernel(changed: dict[str, Any]) -> None:
    before, after = aperture_of(**EVERYTHING), aperture_of(**EVERYTHING | changed)
    kernels = [seen.seen(1, (0.8, 0.6), 0).rasterize(21.0 * seen.channel_scale(1)[0]).kernel for seen in (before, after)]
    assert kernels[0].shape != kernels[1].shape or np.abs(kernels[0] - kernels[1]).max() > 1e-4


@pytest.mark.parametrize("changed", [{"tilt_deg": [2, 0]}, {"tilt_deg": [0, -2]}, {"petzval_radius_mm": 60}])
def test_tilt_and_curvature_are_read(changed: dict[str, Any]) -> None:
    lens = lens_from_json(BODY | {"aperture": {"shape": "disc"}} | changed)
    assert not lens.has_flat_focus
    assert lens.tilt_rad == pytest.approx(tuple(np.radians(changed.get("tilt_deg", [0, 0]))))
    assert lens.petzval_radius_mm == changed.get("petzval_radius_mm", np.inf)


def test_an_image_is_found_beside_the_lens_file_and_may_have_grey_levels(tmp_path: Path) -> None:
    """A white disc of half the opacity on transparent white: opacity counts, its scale does not."""
    y, x = np.mgrid[:64, :64] + 0.5
    cover = np.clip(20.5 - np.hypot(x - 32, y - 32), 0, 1)
    picture = np.dstack([np.full((64, 64, 3), 255.0), cover * 128]).astype(np.uint8)
    (tmp_path / "sub").mkdir()
    cv2.imwrite(str(tmp_path / "sub" / "disc.png"), picture)
    (tmp_path / "sub" / "lens.json").write_text(json.dumps(BODY | {"aperture": {"shape": "image", "image": "disc.png"}}))
    outlines = read_lens(tmp_path / "sub" / "lens.json").aperture.outlines
    assert len(outlines) == 1 and np.hypot(*outlines[0].T).min() > 0.98
    cv2.imwrite(str(tmp_path / "ramp.png"), np.repeat(np.linspace(0, 65535, 64).astype(np.uint16)[None], 32, axis=0))
    document = BODY | {"aperture": {"shape": "image", "image": "ramp.png", "levels": 4}}
    assert lens_from_json(document, folder=tmp_path).aperture.weights == (0.25,) * 4
    assert len(lens_from_json(BODY | {"aperture": {"shape": "image", "image": "ramp.png"}}, folder=tmp_path).aperture.weights) == 1


@pytest.mark.parametrize(("changed", "message"), [
    ({"f_nummer": 2}, "'f_nummer'"), ({"f_number": -1.8}, "must be above 0"), ({"f_number": "1.8"}, "f_number to be a number"),
    ({"f_number": True}, "f_number to be a number"), ({"f_number": None}, "f_number to be a number"),
    ({"focus_distance_m": float("nan")}, "focus_distance_m to be a number"),
    ({"f_number": float("nan")}, "f_number to be a number"), ({"focus_distance_m": 0.04}, "cannot focus"),
    ({"sensor_width_mm": float("inf")}, "sensor_width_mm to be a number"), ({"tilt_deg": 3}, "tilt_deg to be a list of 2 numbers"),
    ({"tilt_deg": [0, 60]}, "45 degrees"), ({"petzval_radius_mm": 0}, "petzval_radius_mm"),
    ({"aperture": "disc"}, "expected an object"), ({"aperture": {}}, "incomplete: shape"), ({"version": 2}, "version 1"),
])  # fmt: skip
def test_mistakes_in_a_lens_are_named(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        lens_from_json(BODY | {"aperture": {"shape": "disc"}} | changed)


@pytest.mark.parametrize(("aperture", "message"), [
    ({"shape": "blob"}, "expected a shape out of disc, polygon"), ({"shape": "disc", "cateye": 0.5}, "'cateye'"),
    ({"shape": "polygon"}, "blades missing"), ({"shape": "polygon", "blades": 6.5}, "blades to be a whole number"),
    ({"shape": "polygon", "blades": 2}, "3 to 100 blades"), ({"shape": "polygon", "blades": 6, "curvature": 2}, "curvature"),
    ({"shape": "ring"}, "inner missing"), ({"shape": "ring", "inner": 1.5}, "below 1"), ({"shape": "outline"}, "either points"),
    ({"shape": "outline", "points": [[0, 0], [1, 1], [2, "x"]]}, "at least 3 points"),
    ({"shape": ["disc"]}, "expected a shape out of"), ({"shape": "outline", "points": [[0, 0], [1, 1]]}, "at least 3 points"),
    ({"shape": "image", "image": ""}, "image to be a text"), ({"shape": "disc", "cat_eye": 1.5}, "cat_eye must lie between"),
    ({"shape": "disc", "squeeze": 0}, "squeeze"), ({"shape": "disc", "rims": [[1, 2, 3]]}, "rims to be a list of pairs"),
    ({"shape": "disc", "rims": [[0.1, -1]]}, "rims as pairs of a shift"), ({"shape": "disc", "iris_blades": 1}, "3 to"),
    ({"shape": "disc", "axial_chromatic": [0, 0]}, "axial_chromatic to be a list of 3 numbers"),
    ({"outlines": [[[0, 0], [1, 0], [0, 1]]], "weights": [0]}, "let light through"),
    ({"outlines": [[[0, 0], [1, 0], [0, 1]]]}, "weights missing"),
    ({"outlines": [[[0, 0], [1, 0], [0, 1]]], "weights": [1], "shape": "disc"}, "'shape'"),
])  # fmt: skip
def test_mistakes_in_an_aperture_are_named(aperture: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        aperture_of(**aperture)


@pytest.mark.parametrize("widest", [-1.0, 0.0, 8.0])
def test_a_lens_opens_no_less_far_than_it_is_open(widest: float) -> None:
    with pytest.raises(InputError, match="no more than the f_number of 4"):
        Lens(50.0, 4.0, 2.0, widest_f_number=widest)


def test_rims_and_the_widest_f_number_are_written_and_read(tmp_path: Path) -> None:
    opening = replace(Aperture.disc(), rims=((0.4, 1.1), (-0.3, 0.9)), iris_blades=9)
    lens = Lens(85.0, 1.5, 3.0, aperture=opening, widest_f_number=1.4)
    write_lens(tmp_path / "lens.json", lens)
    again = read_lens(tmp_path / "lens.json")
    assert again.aperture.rims == opening.rims and again.aperture.iris_blades == 9 and again.widest_f_number == 1.4


def test_a_lens_file_that_is_none_is_named(tmp_path: Path) -> None:
    path, image = tmp_path / "lens.json", json.dumps(BODY | {"aperture": {"shape": "image", "image": "none.png"}})
    for text, said in (
        (None, "no such file"),
        ("{ not json", "not JSON"),
        ('{"format": "something else"}', "mrbokeh lens new"),
        (image, r"none\.png, but there is no such file"),
    ):
        if text is not None:
            path.write_text(text)
        with pytest.raises(InputError, match=said):
            read_lens(path)
    (tmp_path / "none.png").write_text("not a picture")
    with pytest.raises(InputError, match="cannot be read as a picture"):
        read_lens(path)
    with pytest.raises(InputError, match="incomplete: aperture"):
        lens_from_json({key: value for key, value in lens_to_json(NIKKOR).items() if key != "aperture"})
