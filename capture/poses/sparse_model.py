"""SparseModel: cameras of many viewpoints and the points they saw in common, as structure from motion finds them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from capture.poses.distortion import Distortion, distorted_px, undistorted_px
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class SparseView:
    """One viewpoint.

    name: of its stack (folder below the scene).
    camera: the pinhole part; the translation of camera_from_world is in the model's unit.
    distortion: radial k1, k2 (see `distortion`); 0, 0 is a pinhole.
    """

    name: str
    camera: Camera
    distortion: Distortion = (0.0, 0.0)

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """The camera's centre (entrance pupil) in the world, in the model's unit."""
        return self.camera.world_from_camera[:3, 3]

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """World points to (positions in the picture, depth along the axis in the model's unit)."""
        xy_px, depth = self.camera.project(points)
        return distorted_px(self.camera, self.distortion, xy_px), depth

    def unproject(self, xy_px: Float[np.ndarray, "*batch 2"], depth: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        """Positions in the picture at a depth to world points: the inverse of `project`."""
        return self.camera.unproject(undistorted_px(self.camera, self.distortion, xy_px), depth)


@dataclass(frozen=True)
class SparseModel:
    """Views, points and who saw what. All lengths are in the model's own unit.

    errors_px: mean distance between where a point is seen and where it projects to.
    observations: (M, 2) index of the view, index of the point; observed_xy_px: (M, 2) where, in the picture.
    metres_per_unit: None until the scale is known; 1 where lengths are metres.
    left_out: names of views that could not be placed.
    """

    views: tuple[SparseView, ...]
    points: Float[np.ndarray, "points 3"]
    errors_px: Float[np.ndarray, " points"]
    observations: Int[np.ndarray, "observations 2"]
    observed_xy_px: Float[np.ndarray, "observations 2"]
    metres_per_unit: float | None = None
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.observations) and not (
            self.observations.min() >= 0
            and self.observations[:, 0].max() < len(self.views)
            and self.observations[:, 1].max() < len(self.points)
        ):
            raise InputError(
                f"the observations of a sparse model must name one of its {len(self.views)} views and {len(self.points)} points: "
                f"they do not, so run `mrbokeh capture poses --overwrite`"
            )

    def view(self, name: str) -> SparseView:
        return self.views[self.index_of(name)]

    def index_of(self, name: str) -> int:
        for index, each in enumerate(self.views):
            if each.name == name:
                return index
        why = " (it was left out, see poses.json)" if name in self.left_out else ""
        raise InputError(f"expected a view of the sparse model, got {name!r}{why}: choose one of {', '.join(v.name for v in self.views)}")

    def scaled(self) -> "SparseModel":
        """The same in metres. Raises InputError where the scale is not known."""
        if self.metres_per_unit is None:
            raise InputError("the poses have no scale in metres yet: run `mrbokeh capture scale` on the scene")
        return self.times(self.metres_per_unit)

    def times(self, metres_per_unit: float) -> "SparseModel":
        """All lengths multiplied by a trial scale; the result counts as metres."""
        views = []
        for each in self.views:
            pose = each.camera.camera_from_world.copy()
            pose[:3, 3] *= metres_per_unit
            views.append(replace(each, camera=replace(each.camera, camera_from_world=pose)))
        return replace(self, views=tuple(views), points=self.points * metres_per_unit, metres_per_unit=1.0)

    def moved(self, there_from_world: Float[np.ndarray, "4 4"]) -> "SparseModel":
        """The same in another world: a rotation and a shift in the model's unit."""
        back = np.linalg.inv(there_from_world)
        views = tuple(
            replace(each, camera=replace(each.camera, camera_from_world=each.camera.camera_from_world @ back)) for each in self.views
        )
        return replace(self, views=views, points=self.points @ there_from_world[:3, :3].T + there_from_world[:3, 3])

    def points_of(self, view: SparseView | str) -> Int[np.ndarray, " seen"]:
        """Indices of the points that a view observes, in the order of `depths_in`."""
        return self.observations[self._of_view(view), 1]

    def depths_in(self, view: SparseView | str) -> tuple[Float[np.ndarray, "seen 2"], Float[np.ndarray, " seen"]]:
        """(positions in the picture (K, 2), depth along the axis (K,) in the model's unit) of the points that a view observes."""
        seen = self.view(view) if isinstance(view, str) else view
        _, depth = seen.camera.project(self.points[self.points_of(view)])
        return self.observed_xy_px[self._of_view(view)], depth

    def _of_view(self, view: SparseView | str) -> Int[np.ndarray, " seen"]:
        name = view if isinstance(view, str) else view.name
        return np.flatnonzero(self.observations[:, 0] == self.index_of(name))
