"""Intersections in Mitsuba's scalar variant, ray by ray (2 millionths of a second each), for arrays of rays in NumPy."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from datasets_scripts.truth_mitsuba import SCALAR, load, scene_of

Points = Float[np.ndarray, "n 3"]
Pairs = Float[np.ndarray, "n 2"]
Numbers = Float[np.ndarray, " n"]
Flags = Bool[np.ndarray, " n"]


class ScalarBodies:
    """Triangles that rays may meet."""

    def __init__(self, vertices_m: Float32[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "triangles 3"]) -> None:
        self._scene, self._ray = scene_of(SCALAR, vertices_m, triangles), load(SCALAR).Ray3f

    def nearest(self, starts_m: Points, towards: Points) -> tuple[Numbers, Int[np.ndarray, " n"], Numbers, Numbers]:
        """(distance or inf, number of the triangle, barycentric weights of its second and third corner) of the first hits."""
        found = np.full((len(starts_m), 4), (np.inf, 0, 0, 0))
        for index, (start, direction) in enumerate(zip(starts_m.tolist(), towards.tolist(), strict=True)):
            hit = self._scene.ray_intersect_preliminary(self._ray(start, direction))
            if hit.is_valid():
                found[index] = hit.t, hit.prim_index, hit.prim_uv.x, hit.prim_uv.y
        return found[:, 0], found[:, 1].astype(int), found[:, 2], found[:, 3]

    def blocked(self, starts_m: Points, towards: Points, reach: float, asked: Flags) -> Flags:
        """Whether a triangle lies within `reach` times `towards` of the start; False where not asked."""
        blocked = np.zeros(len(starts_m), bool)
        length_m = np.linalg.norm(towards, axis=1)
        for index in np.flatnonzero(asked):
            ray = self._ray(starts_m[index].tolist(), (towards[index] / length_m[index]).tolist())
            if np.isfinite(reach):
                ray.maxt = float(length_m[index] * reach)
            blocked[index] = self._scene.ray_test(ray)
        return blocked
