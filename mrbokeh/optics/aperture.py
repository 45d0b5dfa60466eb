"""Aperture: the opening of a lens as a weighted sum of polygons, and the PSF that it casts."""

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields, replace

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.optics import aperture_shapes
from mrbokeh.optics.aperture_shapes import CIRCLE_SIDES, clipped, clipped_by_rim, joined, net_area, radially_weighted, shifted, unit_disc
from mrbokeh.optics.psf import Psf, identity_psf, kernel_radius_px
from mrbokeh.system.errors import InputError

PerColour = tuple[float, float, float]
_NO_COLOUR: PerColour = (0.0, 0.0, 0.0)
_LEAST_LIGHT = 1e-9
_FARTHEST_RIM, _MOST_BLADES = 1e4, 32


@dataclass(frozen=True, eq=False)
class Aperture:
    """Weighted polygons in the unit pupil, seen from behind the camera: x right, y down; and how the lens modifies them.

    outlines: each (V, 2), within about 1 of the origin, not crossing itself.
    weights: one number per outline; a ring is +1 for the outer and -1 for the inner outline.
    A point behind the focus plane shows the outlines as they are, a point in front shows them mirrored through
    the origin: follow the ray through lens point u, it is displaced by u times half the signed circle of confusion.
    The origin is where an unblurred point lies; the makers of shapes (mrbokeh.optics.aperture_shapes) put the centroid of
    light there, so that a blurred point stays in place.

    Modifiers; 0 is neutral. A field position is x right, y down, in half diagonals of the frame (length 1 in a corner).
    cat_eye: -1 to 1. The pupil is clipped by a round rim of radius 1 whose centre lies at -cat_eye times the field
      position: a rim in front of the pupil where positive, behind it where negative.
    rims: (shift, radius) of more such rims: of that radius, their centres at -shift times the field position.
    iris_blades: of an iris that is round while it is fully open and shows straight blades once it closes (`stopped_down`).
    spherical_aberration: -1 to 1. Behind the focus light is weighted by 1 + s (2 rho^2 - 1) over the pupil radius rho, in
      front by 1 - s (2 rho^2 - 1): positive (over-corrected) gives bright rims behind and soft ones in front.
    axial_chromatic: (r, g, b), each in (-1, 1). The circle of confusion of a colour is 1 + side times this as large.
    lateral_chromatic: (r, g, b), each -1 to 1. The pupil of a colour is displaced by this times the field position, so
      that its blur is displaced the more the larger it is (outwards behind the focus where positive, inwards in front,
      because the pupil is mirrored there) and what is in focus stays in register.
    `seen` resolves all of them but axial_chromatic, which is `channel_scale`.
    """

    outlines: tuple[Float64[np.ndarray, "_ 2"], ...]
    weights: tuple[float, ...]
    cat_eye: float = 0.0
    spherical_aberration: float = 0.0
    axial_chromatic: PerColour = _NO_COLOUR
    lateral_chromatic: PerColour = _NO_COLOUR
    rims: tuple[tuple[float, float], ...] = ()
    iris_blades: int = 0
    _seen: dict[tuple[object, ...], "Aperture"] = field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        vertices = sum(map(len, self.outlines))
        changed = [
            f", {each.name}={getattr(self, each.name)}"
            for each in fields(self)
            if each.repr and each.default is not MISSING and getattr(self, each.name) != each.default
        ]
        return f"Aperture({len(self.outlines)} outline{'s' * (len(self.outlines) > 1)} of {vertices} vertices{''.join(changed)})"

    def __post_init__(self) -> None:
        if len(self.outlines) != len(self.weights) or not self.outlines:
            raise InputError(f"an aperture needs one weight per outline, but came with {len(self.outlines)} and {len(self.weights)}")
        if any(outline.ndim != 2 or outline.shape[0] < 3 or outline.shape[1] != 2 for outline in self.outlines):
            raise InputError("every outline of an aperture must be (V, 2) with at least 3 vertices")
        if not (all(np.isfinite(outline).all() for outline in self.outlines) and np.isfinite(self.weights).all()):
            raise InputError("the outlines and weights of an aperture must be finite numbers, but some are NaN or infinite")
        light = net_area((self.outlines, self.weights))
        if not light > _LEAST_LIGHT:
            raise InputError(
                f"an aperture must let light through, but its outlines times weights add up to an area of {light:.3g}: "
                f"outlines that open need positive weights, and what is taken away must be less than they are"
            )
        _check_modifiers(self)

    @classmethod
    def disc(cls, sides: int = CIRCLE_SIDES) -> "Aperture":
        """Return a round opening: a regular polygon with the area of the unit disc, so that it passes the same light."""
        return cls((unit_disc(sides),), (1.0,))

    @classmethod
    def blades(cls, count: int, rotation_rad: float = 0.0, curvature: float = 0.0) -> "Aperture":
        """Return an iris of `count` blades with its corners on the unit circle, the first at `rotation_rad` from x towards y.

        curvature: 1 over the radius of the blades in pupil radii (McGraw Fig. 7 names the radius: 2.0, 1.5, 1.0 there are
        0.5, 0.67, 1 here). 0: straight, 1: the unit circle, negative: blades that bulge inwards.
        """
        return cls((aperture_shapes.blades(count, rotation_rad, curvature),), (1.0,))

    @classmethod
    def ring(cls, inner: float) -> "Aperture":
        """Return a disc whose inner part, `inner` (0 to below 1) of the diameter, is closed: a mirror lens, a doughnut."""
        return cls.disc().obstructed(inner)

    @classmethod
    def star(cls, points: int = 5, inner: float = 0.4, rotation_rad: float = 0.0) -> "Aperture":
        """Return a star: tips on the unit circle, the first one upwards (turned by `rotation_rad` from x towards y), notches at radius
        `inner`.
        """
        return cls((aperture_shapes.star(points, inner, rotation_rad),), (1.0,))

    @classmethod
    def heart(cls) -> "Aperture":
        """Return a heart, tip down behind the focus; the centroid of its light is the origin, its farthest point lies at radius 1."""
        return cls((aperture_shapes.heart(),), (1.0,))

    @classmethod
    def from_picture(cls, transmission: Float[np.ndarray, "height width"], levels: int = 1) -> "Aperture":
        """Trace an opening from a picture (H, W), light where open, in `levels` steps of grey; see `aperture_shapes.from_picture`."""
        return cls(*aperture_shapes.from_picture(transmission, levels))

    @classmethod
    def from_outline(cls, outline: str | Sequence[Sequence[float]] | Float64[np.ndarray, "points 2"]) -> "Aperture":
        """Return an opening from corners [[x, y], ...] or the `d` of an SVG path, y down; moved and scaled as a heart is."""
        traced = aperture_shapes.from_svg_path(outline) if isinstance(outline, str) else aperture_shapes.from_points(outline)
        return cls(*traced)

    def obstructed(self, share: float) -> "Aperture":
        """Return the opening with a round stop in the middle, like the mirror of a catadioptric lens: points blur to rings.

        share: diameter of the stop over that of the unit pupil, 0 to below 1. If the stop reaches beyond the opening, only the covered part
        is taken away.
        """
        if not 0.0 <= share < 1.0:
            raise InputError(f"a central obstruction is a share of the diameter from 0 to below 1, got {share}")
        if share == 0.0:
            return self
        pairs = zip(self.outlines, self.weights, strict=True)
        stops = [clipped(outline, share * unit_disc(), -weight) for outline, weight in pairs]
        outlines, weights = joined([(self.outlines, self.weights), *stops])
        return replace(self, outlines=outlines, weights=weights)

    def rotated(self, angle_rad: float) -> "Aperture":
        """Return the opening turned about the origin from x towards y: clockwise in the picture, behind the focus and in front."""
        if angle_rad == 0.0:
            return self
        turn = np.array([[np.cos(angle_rad), np.sin(angle_rad)], [-np.sin(angle_rad), np.cos(angle_rad)]])
        return replace(self, outlines=tuple(outline @ turn for outline in self.outlines))

    def squeezed(self, squeeze: float) -> "Aperture":
        """Return the opening of an anamorphic lens: after desqueezing, blur is `squeeze` times as high as wide (x is divided by it)."""
        if not (np.isfinite(squeeze) and squeeze > 0.0):
            raise InputError(f"an anamorphic squeeze is a positive number such as 1.33 or 2 (1: none), got {squeeze}")
        return self if squeeze == 1.0 else replace(self, outlines=tuple(outline / np.array([squeeze, 1.0]) for outline in self.outlines))

    def stopped_down(self, ratio: float) -> "Aperture":
        """Return the opening of a pupil whose diameter is `ratio` (at least 1) times smaller: rims stay in the barrel and aberrations fade.

        Rims grow in units of the pupil. Defocus bends a wave by rho^2 and spherical aberration by rho^4 (Born and Wolf 5.3), so that the
        weight over the pupil that it causes falls with the square of the ratio, as the share by which it changes the size of green does;
        the focus of red and blue against that of green stays. A round iris shows its blades, if it has any.
        """
        if ratio == 1.0:
            return self
        red, green, blue = self.axial_chromatic
        closed = replace(self, outlines=(aperture_shapes.blades(self.iris_blades, 0.0, 0.0),), weights=(1.0,)) if self.iris_blades else self
        return replace(
            closed,
            cat_eye=0.0,
            rims=tuple((shift * ratio, radius * ratio) for shift, radius in (*self.rims, *([(self.cat_eye, 1.0)] if self.cat_eye else []))),
            spherical_aberration=self.spherical_aberration / ratio**2,
            axial_chromatic=(red - green + green / ratio**2, green / ratio**2, blue - green + green / ratio**2),
        )

    @property
    def is_plain(self) -> bool:
        """Return whether all modifiers are neutral: the same weighted polygons everywhere and for every colour."""
        return not (self.varies_over_field or self.is_chromatic or self.spherical_aberration)

    @property
    def varies_over_field(self) -> bool:
        """Return whether the pupil looks different from different places in the frame."""
        return self.cat_eye != 0.0 or bool(self.rims) or any(self.lateral_chromatic)

    @property
    def is_chromatic(self) -> bool:
        """Return whether blur differs from colour to colour."""
        return any(self.axial_chromatic) or any(self.lateral_chromatic)

    def channel_scale(self, side: int) -> PerColour:
        """Return the factor on the circle of confusion of each colour; side: +1 behind the focus, -1 in front."""
        red, green, blue = (1.0 + _sign(side) * share for share in self.axial_chromatic)
        return red, green, blue

    def seen(self, side: int, field_xy: tuple[float, float] = (0.0, 0.0), channel: int | None = None) -> "Aperture":
        """Return the plain aperture that a point sees; in front of the focus it still has to be mirrored.

        side: +1 behind the focus, -1 in front. field_xy: place in the frame, in half diagonals. channel: 0, 1, 2 for red,
        green, blue; None for no colour (without lateral_chromatic). The result is kept, and is `self` where self is plain.
        """
        if self.is_plain:
            return self
        _sign(side)
        drift = 0.0 if channel is None else self.lateral_chromatic[channel]
        place = (float(field_xy[0]), float(field_xy[1])) if self.varies_over_field else (0.0, 0.0)
        key = (side if self.spherical_aberration else 0, place, drift)
        if key not in self._seen:
            if drift and any(place):
                uncoloured = self.seen(side, place)
                self._seen[key] = Aperture(*shifted((uncoloured.outlines, uncoloured.weights), (drift * place[0], drift * place[1])))
            else:
                self._seen[key] = self._without_colour(side, place)
        return self._seen[key]

    def _without_colour(self, side: int, field_xy: tuple[float, float]) -> "Aperture":
        """Apply the weight over the pupil, then the rim that cuts it."""
        opening = (self.outlines, self.weights)
        if self.spherical_aberration:
            opening = radially_weighted(opening, side * self.spherical_aberration)
        for shift, radius in (*([(self.cat_eye, 1.0)] if self.cat_eye else []), *self.rims):
            opening = clipped_by_rim(opening, (-shift * field_xy[0], -shift * field_xy[1]), radius) if opening[0] else opening
        if not opening[0] or not net_area(opening) > _LEAST_LIGHT:
            told = f"cat_eye {self.cat_eye}" if not self.rims else f"the rims {self.rims}"
            raise InputError(f"no light passes at field position {field_xy}: expected an opening there, but {told} cut all of it away")
        return Aperture(*opening)

    @property
    def unit_radius(self) -> float:
        """Return the distance of the farthest vertex from the centre of the pupil, before any modifier."""
        return max(float(np.hypot(*outline.T).max()) for outline in self.outlines)

    def packed(self) -> tuple[Float64[np.ndarray, "vertices 2"], np.ndarray, Float64[np.ndarray, " outlines"]]:
        """Return (vertices of all outlines, where each starts, weights) of a plain aperture, the form that compiled code takes."""
        if not self.is_plain:
            raise InputError("this aperture changes over the frame, the side of the focus or the colours: ask for what a point has `seen`")
        starts = np.cumsum([0, *(len(outline) for outline in self.outlines)])
        return np.concatenate(self.outlines), starts, np.asarray(self.weights, np.float64)

    def rasterize(self, diameter_px: float) -> Psf:
        """Return the PSF at a signed diameter with exact area coverage, sum 1; up to one pixel it is the identity.

        Openings within the unit circle are the identity up to one pixel by themselves. Those that reach beyond (see
        `mrbokeh.optics.psf.shown_diameter_px`) grow out of it a little faster, so that nothing jumps. An aperture that is not
        plain is shown as in the middle of the frame, without colour.
        """
        from mrbokeh.optics._aperture_numba import fill_psf

        if not np.isfinite(diameter_px):
            raise InputError(f"a PSF needs a finite diameter in pixels, got {diameter_px}")
        if abs(diameter_px) <= 1.0:
            return identity_psf()
        plain = self.seen(1 if diameter_px > 0 else -1)
        size = 2 * kernel_radius_px(diameter_px, plain.unit_radius) + 1
        kernel, steps = np.zeros((size, size)), np.zeros((size, size))
        fill_psf(kernel, steps, *plain.packed(), float(diameter_px))
        return Psf(kernel)


def _sign(side: int) -> int:
    if side not in (1, -1):
        raise InputError(f"a side of the focus is +1 (behind) or -1 (in front), got {side}")
    return side


def _check_modifiers(aperture: Aperture) -> None:
    for name in ("cat_eye", "spherical_aberration"):
        if not abs(getattr(aperture, name)) <= 1.0:
            raise InputError(f"{name} must lie between -1 and 1 (0: none), got {getattr(aperture, name)}")
    if not all(len(rim) == 2 and abs(rim[0]) <= _FARTHEST_RIM and 0.0 < rim[1] <= _FARTHEST_RIM for rim in aperture.rims):
        raise InputError(f"expected rims as pairs of a shift and a radius above 0, both at most {_FARTHEST_RIM:g}, got {aperture.rims}")
    if aperture.iris_blades and not 3 <= aperture.iris_blades <= _MOST_BLADES:
        raise InputError(f"expected iris_blades from 3 to {_MOST_BLADES} (0: a round iris), got {aperture.iris_blades}")
    if len(aperture.axial_chromatic) != 3 or not all(abs(share) < 1.0 for share in aperture.axial_chromatic):
        raise InputError(f"axial_chromatic needs three numbers (r, g, b) within (-1, 1), got {aperture.axial_chromatic}")
    if len(aperture.lateral_chromatic) != 3 or not all(abs(share) <= 1.0 for share in aperture.lateral_chromatic):
        raise InputError(f"lateral_chromatic needs three numbers (r, g, b) from -1 to 1, got {aperture.lateral_chromatic}")
