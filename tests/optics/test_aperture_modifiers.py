"""Cat-eyes, spherical and chromatic aberration: closed formulas, signs, and that neutral changes nothing."""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import centroid, net_area
from mrbokeh.system.errors import InputError

SHAPES = {
    "disc": Aperture.disc(), "blades": Aperture.blades(7, 0.2, 0.4), "ring": Aperture.ring(0.6), "heart": Aperture.heart(),
    "star": Aperture.star(),
}  # fmt: skip
COLOURS = (0.1, 0.0, -0.1)
MODIFIERS = {"cat_eye": 0.6, "spherical_aberration": 0.7, "axial_chromatic": COLOURS, "lateral_chromatic": COLOURS}
CORNER = (0.8, 0.6)


def light(aperture: Aperture) -> float:
    return net_area((aperture.outlines, aperture.weights))


def middle(aperture: Aperture) -> np.ndarray:
    return centroid((aperture.outlines, aperture.weights))


def kernel_of(aperture: Aperture, diameter_px: float, field_xy: tuple[float, float], channel: int | None) -> np.ndarray:
    """What a renderer does: the plain aperture seen there, at the colour's diameter."""
    side = 1 if diameter_px > 0 else -1
    scale = 1.0 if channel is None else aperture.channel_scale(side)[channel]
    return aperture.seen(side, field_xy, channel).rasterize(diameter_px * scale).kernel


def overlap_of_discs(distance: float) -> float:
    """Area common to two unit discs, over pi."""
    return (2 * np.arccos(distance / 2) - distance / 2 * np.sqrt(4 - distance**2)) / np.pi


@pytest.mark.parametrize("name", MODIFIERS)
def test_every_modifier_changes_the_kernel_and_its_neutral_value_changes_nothing(name: str) -> None:
    for shape in SHAPES.values():
        plain = kernel_of(shape, 21.3, CORNER, 0)
        changed = replace(shape, **{name: MODIFIERS[name]})
        neutral = replace(shape, **{name: 0.0 if isinstance(MODIFIERS[name], float) else (0.0, 0.0, 0.0)})
        assert shape.is_plain and neutral.is_plain and not changed.is_plain
        assert neutral.seen(1, CORNER, 0) is neutral
        np.testing.assert_array_equal(kernel_of(neutral, 21.3, CORNER, 0), plain)
        different = kernel_of(changed, 21.3, CORNER, 0)
        assert different.shape != plain.shape or np.abs(different - plain).max() > 1e-4


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("diameter_px", [-25.0, -1.4, 0.9, 1.1, 3.0, 25.0])
def test_all_together_leave_a_sum_of_one_and_no_negative_light(name: str, diameter_px: float) -> None:
    aperture = replace(SHAPES[name], **(MODIFIERS | {"spherical_aberration": -1.0}))
    for field_xy in ((0.0, 0.0), (0.5, 0.0), CORNER):
        for channel in (None, 0, 1, 2):
            kernel = kernel_of(aperture, diameter_px, field_xy, channel)
            assert kernel.sum() == pytest.approx(1.0, rel=1e-12) and kernel.min() > -1e-15


def test_what_is_seen_is_plain_kept_and_varies_as_its_modifiers_do() -> None:
    changed = {name: replace(Aperture.disc(), **{name: value}) for name, value in MODIFIERS.items()}
    assert {name for name, aperture in changed.items() if aperture.varies_over_field} == {"cat_eye", "lateral_chromatic"}
    assert {name for name, aperture in changed.items() if aperture.is_chromatic} == {"axial_chromatic", "lateral_chromatic"}
    aperture = replace(Aperture.heart(), **MODIFIERS)
    seen = aperture.seen(-1, CORNER, 2)
    assert seen.is_plain and aperture.seen(-1, CORNER, 2) is seen and aperture.seen(1, CORNER, 2) is not seen
    with pytest.raises(InputError, match="seen"):
        aperture.packed()
    with pytest.raises(InputError, match="side"):
        aperture.seen(0, CORNER)
    changed = replace(Aperture.disc(), **MODIFIERS)
    for again in (changed.obstructed(0.5), changed.squeezed(1.5), changed.rotated(0.1)):
        assert all(getattr(again, name) == value for name, value in MODIFIERS.items())


@pytest.mark.parametrize("cat_eye", [0.1, 0.5, 1.0, -0.5])
def test_a_cat_eye_leaves_the_overlap_of_two_discs(cat_eye: float) -> None:
    for share in (0.5, 1.0):
        seen = replace(Aperture.disc(), cat_eye=cat_eye).seen(1, (share * CORNER[0], share * CORNER[1]))
        assert light(seen) / np.pi == pytest.approx(overlap_of_discs(abs(cat_eye) * share), rel=1e-3)


def test_a_cat_eye_is_the_opening_itself_in_the_middle_and_its_front_rim_leaves_the_half_towards_it() -> None:
    """By symmetry the lens-shaped opening has its centroid halfway between both discs, at -cat_eye / 2 times the field."""
    np.testing.assert_allclose(middle(replace(Aperture.disc(), cat_eye=0.6).seen(1, CORNER)), [-0.24, -0.18], atol=1e-3)
    np.testing.assert_allclose(middle(replace(Aperture.disc(), cat_eye=-0.6).seen(1, CORNER)), [0.24, 0.18], atol=1e-3)
    for shape in SHAPES.values():
        assert replace(shape, cat_eye=0.8).seen(1, (0.0, 0.0)).outlines[0] is shape.outlines[0]
    seen = replace(Aperture.ring(0.4), cat_eye=0.5).seen(1, CORNER)
    assert light(seen) / np.pi == pytest.approx(overlap_of_discs(0.5) - 0.4**2, rel=1e-3)


def test_a_rim_may_cut_an_opening_into_parts_or_hide_it() -> None:
    """A U, 1.2 wide, with arms 0.2 wide: a rim displaced upwards by 0.6 (reaching down to 0.4) cuts off its foot."""
    u_shape = np.array([[-0.6, -0.6], [-0.4, -0.6], [-0.4, 0.5], [0.4, 0.5], [0.4, -0.6], [0.6, -0.6], [0.6, 0.7], [-0.6, 0.7]])
    seen = Aperture((u_shape,), (1.0,), cat_eye=0.6).seen(1, (0.0, 1.0))
    assert seen.weights == (1.0, 1.0) and len(seen.outlines) == 2
    far_left = Aperture((np.array([[-1.0, -0.1], [-0.9, -0.1], [-0.9, 0.1]]),), (1.0,), cat_eye=1.0)
    with pytest.raises(InputError, match="no light passes"):
        far_left.seen(1, (-1.0, 0.0))


def test_rims_cut_as_cat_eyes_do_and_stay_where_they_are_while_the_iris_closes() -> None:
    """A rim of radius 1 is a cat-eye; a closed iris of half the diameter sees it twice as far off and twice as large."""
    rimmed, cat_eyed = replace(Aperture.disc(), rims=((0.6, 1.0),)), replace(Aperture.disc(), cat_eye=0.6)
    np.testing.assert_array_equal(rimmed.seen(1, CORNER).outlines[0], cat_eyed.seen(1, CORNER).outlines[0])
    both = replace(Aperture.disc(), rims=((0.5, 1.0), (-0.5, 1.0)))
    assert light(both.seen(1, CORNER)) / np.pi == pytest.approx(overlap_of_discs(1.0), rel=1e-3)
    assert not rimmed.is_plain and rimmed.varies_over_field and not rimmed.is_chromatic
    changed = replace(rimmed, spherical_aberration=0.8, axial_chromatic=(0.3, 0.2, 0.1), iris_blades=6)
    assert changed.stopped_down(1.0) is changed
    for closed in (changed.stopped_down(2.0), replace(changed, rims=(), cat_eye=0.6).stopped_down(2.0)):
        assert closed.rims == ((1.2, 2.0),) and closed.cat_eye == 0.0 and closed.outlines[0].shape == (6, 2)
        assert closed.spherical_aberration == pytest.approx(0.2)  # a quarter: it falls with the square of the diameter
        assert closed.axial_chromatic == pytest.approx((0.15, 0.05, -0.05))  # so does what green has; red and blue stay beside it
    for wrong in ({"rims": ((0.5, 0.0),)}, {"rims": ((0.5,),)}, {"iris_blades": 2}):
        with pytest.raises(InputError, match="expected"):
            replace(Aperture.disc(), **wrong)
    with pytest.raises(InputError, match="no light passes"):
        replace(Aperture.disc(), rims=((3.0, 1.0),)).seen(1, CORNER)


@pytest.mark.parametrize("strength", [-1.0, -0.4, 0.05, 1.0])
def test_spherical_aberration_weights_by_the_square_of_the_radius(strength: float) -> None:
    """The mean of rho^2 under 1 + s (2 rho^2 - 1) is 1/2 + s/6, with K zones of equal area 1/2 + s/6 (1 - 1/K^2)."""
    zones = max(4, np.ceil(16 * abs(strength)))
    for side in (1, -1):
        seen = replace(Aperture.disc(), spherical_aberration=strength).seen(side)
        assert light(seen) == pytest.approx(np.pi, rel=1e-9), "the light of the disc, moved but not changed"
        kernel = seen.rasterize(201.0).kernel
        y, x = np.mgrid[: len(kernel), : len(kernel)] - len(kernel) // 2
        mean = (kernel * (x**2 + y**2)).sum() / 100.5**2
        assert mean == pytest.approx(0.5 + side * strength / 6 * (1 - 1 / zones**2), rel=1e-3)
        for rho in (0.1, 0.3, 0.55, 0.9):
            there = kernel[np.abs(np.hypot(x, y) - 100.5 * rho) < 0.7].mean() * np.pi * 100.5**2
            assert there == pytest.approx(1 + side * strength * (2 * rho**2 - 1), abs=abs(strength) / zones + 0.01)


def test_spherical_aberration_turns_with_the_side_and_leaves_a_hole_dark() -> None:
    """Over-correction behind the focus is under-correction in front: the same polygons, bit for bit."""
    one, other = (replace(Aperture.heart(), spherical_aberration=sign * 0.6) for sign in (1, -1))
    assert one.seen(1).weights == other.seen(-1).weights
    for a, b in zip(one.seen(1).outlines, other.seen(-1).outlines, strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.rasterize(41.0).kernel[20, 20] < one.rasterize(-41.0).kernel[20, 20], "positive: dark middle behind the focus"
    seen = replace(Aperture.ring(0.6), spherical_aberration=1.0).seen(1)
    assert abs(seen.rasterize(61.0).kernel[30, 30]) < 1e-12
    inside = [outline for outline in seen.outlines if np.hypot(*outline.T).max() < 0.59]
    assert not inside


def test_chromatic_errors_scale_and_displace_the_pupil_of_a_colour() -> None:
    aperture = replace(Aperture.disc(), axial_chromatic=(0.1, 0.0, -0.2))
    assert aperture.channel_scale(1) == pytest.approx((1.1, 1.0, 0.8))
    assert aperture.channel_scale(-1) == pytest.approx((0.9, 1.0, 1.2))
    assert aperture.seen(1, CORNER, 0).outlines[0] is aperture.outlines[0]
    aperture = replace(Aperture.heart(), lateral_chromatic=(0.1, 0.0, -0.2))
    np.testing.assert_allclose(middle(aperture.seen(1, CORNER, 0)), [0.08, 0.06], atol=1e-12)
    np.testing.assert_allclose(middle(aperture.seen(-1, CORNER, 2)), [-0.16, -0.12], atol=1e-12)
    for channel, field_xy in ((1, CORNER), (None, CORNER), (0, (0.0, 0.0))):
        assert aperture.seen(1, field_xy, channel).outlines[0] is aperture.outlines[0]
    # The kernel's centroid lies at 0.1 times the field times half the signed diameter; in focus it is in register.
    aperture = replace(Aperture.disc(), lateral_chromatic=(0.1, 0.0, 0.0))
    for diameter_px in (-40.0, 10.0, 40.0):
        kernel = kernel_of(aperture, diameter_px, (1.0, 0.0), 0)
        offsets = np.arange(len(kernel)) - len(kernel) // 2
        assert (kernel.sum(0) * offsets).sum() == pytest.approx(0.05 * diameter_px, abs=1e-9)
    assert kernel_of(aperture, 1.0, (1.0, 0.0), 0).tolist() == [[1.0]]


def test_modifiers_out_of_range_are_refused() -> None:
    for name, wrong in (
        *(("cat_eye", value) for value in (1.1, float("nan"))),
        ("spherical_aberration", -1.5),
        *(("axial_chromatic", value) for value in ((1.0, 0.0, 0.0), (0.0, float("nan"), 0.0))),
        ("lateral_chromatic", (0.0, 0.0, 2.0)),
    ):
        with pytest.raises(InputError, match=name):
            replace(Aperture.disc(), **{name: wrong})
