"""Simple meshes with exact normals: the sphere, the rectangle and the box of tests, demonstrations and shadow catchers."""

import numpy as np

from mrbokeh.scene.material import Material, Triple
from mrbokeh.scene.mesh import Mesh


def sphere(centre_m: Triple, radius_m: float, material: Material, rows: int = 64) -> Mesh:
    """A sphere of `rows` rings and twice as many meridians, vertices on the sphere (faces therefore a little inside).

    The largest distance between face and sphere is about radius * (pi / rows)**2 / 4.
    """
    polar, longitude = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1), indexing="ij")
    normals = np.stack([np.sin(polar) * np.sin(longitude), -np.cos(polar), -np.sin(polar) * np.cos(longitude)], axis=-1).reshape(-1, 3)
    uvs = np.stack([longitude / (2 * np.pi), polar / np.pi], axis=-1).reshape(1, -1, 2)
    row, column = (index.ravel() for index in np.meshgrid(np.arange(rows), np.arange(2 * rows), indexing="ij"))
    corner = row * (2 * rows + 1) + column
    below = corner + 2 * rows + 1
    quads = np.stack([corner, below + 1, corner + 1, corner, below, below + 1], axis=-1).reshape(-1, 3)
    degenerate = np.stack([row == 0, row == rows - 1], axis=-1).ravel()
    return Mesh(
        positions_m=np.asarray(centre_m) + radius_m * normals,
        triangles=quads[~degenerate].astype(np.int32),
        normals=normals.astype(np.float32),
        uvs=uvs.astype(np.float32),
        material=material,
        name="sphere",
    )


def rectangle(
    corner_m: Triple,
    side_u_m: Triple,
    side_v_m: Triple,
    material: Material,
    catches_shadow: bool = False,
) -> Mesh:
    """The parallelogram corner + u * side_u + v * side_v, u and v from 0 to 1, which are also its texture coordinates.

    Its front is where side_v x side_u points: with u to the right and v down as seen, it faces the viewer.
    """
    corner, side_u, side_v = np.asarray(corner_m, float), np.asarray(side_u_m, float), np.asarray(side_v_m, float)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    normal = np.cross(side_v, side_u)
    return Mesh(
        positions_m=corner + uvs[:, :1] * side_u + uvs[:, 1:] * side_v,
        triangles=np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        normals=np.repeat((normal / np.linalg.norm(normal))[None], 4, axis=0).astype(np.float32),
        uvs=uvs[None],
        material=material,
        name="rectangle",
        catches_shadow=catches_shadow,
    )


def shadow_catcher(height_y_m: float, centre_xz_m: tuple[float, float], half_size_m: float) -> Mesh:
    """A level square at y = height_y_m (up is -y) that is not drawn but receives shadows."""
    x, z = centre_xz_m
    return rectangle(
        (x - half_size_m, height_y_m, z + half_size_m), (2 * half_size_m, 0, 0), (0, 0, -2 * half_size_m), Material(), catches_shadow=True
    )
