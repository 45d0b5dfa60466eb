"""An opening on Dr.Jit's LLVM back end: points of the pupil, and what the front rim lets through."""

from typing import Any

import drjit as dr
import numpy as np

from datasets_scripts.truth_pupil import pupil_table
from datasets_scripts.truth_tracer import Opening, field_scale
from mrbokeh.optics.camera import Camera


class LlvmPupil:
    """radius_m, focus_m: of the Opening. Numbers that change from picture to picture are opaque, so that kernels are reused."""

    def __init__(self, mi: Any, opening: Opening, camera: Camera) -> None:
        self._mi, self._camera, self._cat_eye, self._stop = mi, camera, opening.aperture.cat_eye, opening.stop
        self._varies = opening.varies
        if opening.stop is not None:
            self._shares = opening.shares
            self._share_table = mi.Float(self._shares.table.ravel().astype(np.float32))
        table = pupil_table(opening.aperture)
        self._spans, self._columns, self._count = table.spans, table.bands.shape[1], len(table.bands)
        self._bands = mi.Float(table.bands.ravel())
        self.radius_m, self.focus_m = dr.opaque(mi.Float, 0.5 * opening.diameter_m), dr.opaque(mi.Float, opening.focus_distance_m)

    def point(self, along: Any, across: Any) -> Any:
        """See `PupilTable.points`."""
        mi = self._mi
        scaled = across * self._count
        band = dr.minimum(mi.UInt32(scaled), self._count - 1)
        row = [dr.gather(mi.Float, self._bands, band * self._columns + column) for column in range(self._columns)]
        y = row[0] + (scaled - mi.Float(band)) * (row[1] - row[0])
        widths = [row[2 * span + 3] - row[2 * span + 2] for span in range(self._spans)]
        left = along * sum(widths)
        x = row[2] + left
        for span in range(1, self._spans):
            left = left - widths[span - 1]
            x = dr.select(left > 0, row[2 * span + 2] + left, x)
        return mi.Point2f(x, y)

    def weight(self, ray: Any, inverse_depth: Any, lens_uv: Any) -> Any:
        """1 over the open share where rim and stop let the ray pass, 0 where not; they are placed by where the point seen lies."""
        mi = self._mi
        if not self._varies:
            return mi.Float(1.0)
        return self.open_weight(lens_uv, mi.Vector2f(ray.d.x, ray.d.y) / ray.d.z + mi.Vector2f(lens_uv) * self.radius_m * inverse_depth)

    def open_weight(self, lens_uv: Any, slope: Any) -> Any:
        """The same for a point in the direction `slope` (x / z, y / z) from the middle of the pupil."""
        mi = self._mi
        if not self._varies:
            return mi.Float(1.0)
        (fx, fy), (cx, cy) = self._camera.focal_px, self._camera.principal_px
        middle_x, middle_y, half_diagonal = field_scale(self._camera)
        field = mi.Vector2f(slope.x * fx + cx - middle_x, slope.y * fy + cy - middle_y) / half_diagonal
        passes = dr.squared_norm(mi.Vector2f(lens_uv) + self._cat_eye * field) <= 1.0
        if self._stop is not None:
            radius, stop_x = self._stop.radius_and_shift(field.x, dr.minimum, dr.maximum)
            passes &= dr.square(lens_uv.x - stop_x) + dr.square(lens_uv.y) >= dr.square(radius)
            return dr.select(passes, 1.0 / self._share(field), 0.0)
        half = dr.minimum(0.5 * abs(self._cat_eye) * dr.norm(field), 0.999)
        share = (dr.acos(half) - half * dr.sqrt(1.0 - half * half)) * (2.0 / dr.pi)
        return dr.select(passes, 1.0 / share, 0.0)

    def _share(self, field: Any) -> Any:
        """See `OpenShares.at`."""
        mi, (rows, columns) = self._mi, self._shares.table.shape
        column, row = self._shares.places(field.x, field.y)
        column, row = dr.clip(column, 0.0, columns - 1.001), dr.clip(row, 0.0, rows - 1.001)
        left, top = mi.UInt32(column), mi.UInt32(row)
        across, down = column - mi.Float(left), row - mi.Float(top)
        share = mi.Float(0.0)
        for next_row, share_y in ((0, 1.0 - down), (1, down)):
            for next_column, share_x in ((0, 1.0 - across), (1, across)):
                place = (top + next_row) * columns + left + next_column
                share += share_x * share_y * dr.gather(mi.Float, self._share_table, place)
        return share
