"""Shares of the pupil that near things, a virtual surface and the rest take, place by place of the blurred picture.

Blurred coverages alone do not say it: a wire and the edge of an object behind it may hide the same part of the pupil or two parts of
it. So rays are followed through some evenly spread points of the pupil. Only the common part of two coverages (their covariance) and
ratios are taken from so few rays; coverages and light by themselves come from the renderer.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Int64

from mrbokeh.compositing.near_and_far import NearAndFar
from mrbokeh.images.layer import Layer
from mrbokeh.layering.highlights import without_highlights
from mrbokeh.layering.psf_over_field import Frame, field_cells_of, opening_of_cell
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.pupil_points import pupil_points
from mrbokeh.system.resources import in_bands, workers

_BAND_PLACES = 2048
Plane = Float32[np.ndarray, "height width"]
Places = Int64[np.ndarray, " places"]


@dataclass(frozen=True)
class PupilMeans:
    """Means over the pupil at some places: f is 1 where a ray gets past the near things, a the coverage of the virtual surface.

    virtual, far: light of the virtual surface (premultiplied) and of the rest; past: beyond near and virtual, 1 where f (1 - a) is.
    """

    f: Float32[np.ndarray, " places"]
    a: Float32[np.ndarray, " places"]
    f_a: Float32[np.ndarray, " places"]
    virtual: Float32[np.ndarray, "places 3"]
    f_virtual: Float32[np.ndarray, "places 3"]
    f_far: Float32[np.ndarray, "places 3"]
    past_far: Float32[np.ndarray, "places 3"]
    past: Float32[np.ndarray, " places"]


@dataclass(frozen=True)
class Rays:
    """Sharp near, virtual and far surfaces with their circles of confusion, continued, and the lens that looks at them."""

    scene: NearAndFar
    virtual: Layer
    lens: Lens
    coc_px: Float32[np.ndarray, "3 height width"]
    points: int

    @classmethod
    def of(cls, scene: NearAndFar, virtual: Layer, virtual_depth_m: Plane, lens: Lens, points: int) -> "Rays":
        width = virtual.width_px
        far_coc_px = np.zeros_like(virtual_depth_m) if scene.far_depth_m is None else lens.coc_px(scene.far_depth_m, width)
        coc_px = [lens.coc_px(scene.near.depth_m, width), lens.coc_px(virtual_depth_m, width), far_coc_px]
        return cls(scene, virtual, lens, np.stack(coc_px).astype(np.float32), points)

    def means(self, places: Places) -> PupilMeans:
        """Return means over the pupil at places (row times width plus column) of the picture."""
        from mrbokeh.compositing._between_numba import gather

        sums, near, far = np.zeros((len(places), 16), np.float32), self.scene.near.alpha, self.scene.far_rgb
        in_reach, dark = self.near_in_reach, self.virtual_without_highlights
        for which, aperture in self.cells(places):
            pupil = pupil_points(aperture, self.points).astype(np.float32)
            with workers(len(which) * self.points) as pool:
                work = lambda first, end: gather(sums, places, which[first:end], near, in_reach, dark, far, self.coc_px, pupil)  # noqa: B023, E731
                in_bands(pool, len(which), _BAND_PLACES, work)
        f, a, f_a, past = (sums[:, c] for c in (0, 1, 2, 15))
        return PupilMeans(
            f=f, a=a, f_a=f_a, virtual=sums[:, 3:6], f_virtual=sums[:, 6:9], f_far=sums[:, 9:12], past_far=sums[:, 12:15], past=past
        )

    @cached_property
    def virtual_rgba(self) -> Float32[np.ndarray, "height width 4"]:
        return np.ascontiguousarray(np.dstack([self.virtual.rgb, self.virtual.alpha]))

    @cached_property
    def virtual_without_highlights(self) -> Float32[np.ndarray, "height width 4"]:
        return np.ascontiguousarray(without_highlights(self.virtual_rgba))

    @property
    def one_far_colour(self) -> Bool[np.ndarray, "height width"]:
        """Pixels whose rays all get past the near things and end in one point of the rest: the pupil is shared as in "over"."""
        return ~self.near_in_reach & (self.coc_px[2] == 0.0)

    @cached_property
    def near_in_reach(self) -> Bool[np.ndarray, "height width"]:
        """Pixels whose rays may meet something near: within its blur and a pixel."""
        return self._most_in_reach((self.scene.near.alpha > 0).astype(np.float32), self.coc_px[0]) > 0

    @cached_property
    def most_covering(self) -> Float32[np.ndarray, "height width"]:
        """The greatest alpha of virtual things that a pixel's rays may meet."""
        return self._most_in_reach(self.virtual.alpha, self.coc_px[1])

    def _most_in_reach(self, alpha: Plane, coc_px: Plane) -> Plane:
        """Return the greatest alpha within the blur of all that covers anything, and a pixel."""
        from cv2 import MORPH_RECT, dilate, getStructuringElement

        there = alpha > 0
        if not there.any():
            return alpha
        half_px = 0.5 * float(np.abs(coc_px[there]).max()) * self.lens.aperture.unit_radius
        size = 2 * int(np.ceil(half_px + 2.0)) + 1
        return np.asarray(dilate(alpha, getStructuringElement(MORPH_RECT, (size, size))))

    def cells(self, places: Places) -> Iterator[tuple[Places, Aperture]]:
        """Indices of the places that see one opening, and that opening."""
        aperture, (height, width) = self.lens.aperture, self.virtual.alpha.shape
        frame = Frame(width, height)
        cells = field_cells_of(places // width, places % width, aperture, frame)
        for cell in np.unique(cells):
            yield np.flatnonzero(cells == cell), opening_of_cell(aperture, int(cell), frame)
