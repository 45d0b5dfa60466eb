"""Rays through the surfaces of a lens: `_physical_lens_numba` and `_ray_tracing_numba` for all rays of a block at once."""

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from mrbokeh.psf_models._lens_beam import BANDS_UM, LensBeam
from mrbokeh.psf_models.torch_tracing._lens_points import number, on, pixels, summed
from mrbokeh.system.torch_device import device_named

Rays = Float64[Tensor, " rays"]
Vectors = tuple[Rays, Rays, Rays]
Coloured = Float64[Tensor, "colours rays"]
ColouredVectors = tuple[Coloured, Coloured, Coloured]


class LandedRays:
    """A block of rays of all colours on the sensor. Arguments after the beam as those of `LensBeam.trace`.

    light (rays): by which the weight of a ray is multiplied.
    landings: x and y in mm from the chief ray's place, each (colours, rays). weights (colours, rays): 0 where a ray is lost.
    """

    def __init__(
        self,
        device: str,
        beam: LensBeam,
        chiefs: Float64[np.ndarray, "nodes 5"],
        window: Float64[np.ndarray, "3"],
        shares: Float64[np.ndarray, "rays 3"],
        per_mm: Float64[np.ndarray, " rays"],
        field: Float64[np.ndarray, " rays"],
        light: Float64[np.ndarray, " rays"],
    ) -> None:
        where = device_named(device)
        first, second, third = on(where, shares.T)
        middle_mm, chief = _chief_rays(on(where, chiefs), on(where, field))
        a_from, a_to, b_to = window.tolist()
        starts, aside, length = _from_points(chief, beam.front_mm, on(where, per_mm), a_from + (a_to - a_from) * first, b_to * second)
        tent = torch.where(third < 0.5, torch.sqrt(2.0 * third) - 1.0, 1.0 - torch.sqrt(2.0 - 2.0 * third))
        bands = on(where, BANDS_UM)
        wavelengths_um = bands[:, :1] + bands[:, 1:] * tent
        place, heading, alive = through_surfaces(beam.table, *starts, wavelengths_um)
        alive &= heading[2] > 0.0
        path = (beam.sensor_at_mm - place[2]) / heading[2]
        weights = 1.0 / (aside * length) / chief[3].clamp(min=1e-6) * on(where, light)
        self.weights = torch.where(alive, weights, 0.0)
        self.landings = place[0] + path * heading[0] - middle_mm, place[1] + path * heading[1]

    @property
    def reach_mm(self) -> float:
        """How far from the chief ray's place, along x or y, the farthest light lands."""
        lit = self.weights > 0.0
        return max(float(torch.where(lit, each.abs(), 0.0).max()) for each in self.landings)

    def picture(self, size: int, mm_per_px: float) -> Float64[np.ndarray, "size size colours"]:
        """See `_physical_lens_numba.add_landings`."""
        centre, (x, y) = 0.5 * size, self.landings
        column, aside = centre - x / number(mm_per_px, x), y / number(mm_per_px, y)
        above, is_above = pixels(column, centre - aside, size)
        below, is_below = pixels(column, centre + aside, size)
        weights = torch.where(is_above & is_below, 0.5 * self.weights, 0.0)
        sums = [
            summed(torch.cat([above[colour], below[colour]]), torch.cat([each, each]), size * size) for colour, each in enumerate(weights)
        ]
        return np.stack(sums, axis=1).reshape(size, size, len(sums))


def _chief_rays(
    chiefs: Float64[Tensor, "nodes 5"], field: Float64[Tensor, " rays"]
) -> tuple[Float64[Tensor, " rays"], Float64[Tensor, "4 rays"]]:
    """(x on the sensor, (x and z on the first surface, direction x and z)), linear between the nodes."""
    last = len(chiefs) - 1
    node = field.to(torch.int64).clamp(max=max(last - 1, 0))
    part = (field - node)[:, None]
    middle, x, z, along_x, along_z = ((1.0 - part) * chiefs[node] + part * chiefs[(node + 1).clamp(max=last)]).unbind(1)
    length = torch.sqrt(along_x * along_x + along_z * along_z)
    return middle, torch.stack([x, z, along_x / length, along_z / length])


def _from_points(
    chief: Float64[Tensor, "4 rays"], front_mm: float, per_mm: Rays, a_mm: Rays, b_mm: Rays
) -> tuple[tuple[Vectors, Vectors], Rays, Rays]:
    """((places, directions), square of the ray's length relative to the chief ray's, that length): see `trace_point`."""
    x, z, along_x, along_z = chief
    near = along_z * per_mm / (1.0 + (z - front_mm) * per_mm)
    aside = 1.0 + (a_mm * a_mm + b_mm * b_mm) * near * near
    length = torch.sqrt(aside)
    place = x + a_mm * along_z, b_mm, z - a_mm * along_x
    heading = (along_x + a_mm * near * along_z) / length, b_mm * near / length, (along_z - a_mm * near * along_x) / length
    return (place, heading), aside, length


def through_surfaces(
    table: Float64[np.ndarray, "surfaces 5"], place: Vectors, heading: Vectors, wavelengths_um: Coloured
) -> tuple[ColouredVectors, ColouredVectors, Bool[Tensor, "colours rays"]]:
    """(places on the last surface, directions behind it, whether the ray got through): see `trace_ray`, with rims, from air.

    A lost ray goes on as numbers without a meaning (finite or not).
    """
    (px, py, pz), (x, y, z) = place, heading
    alive = (z > 0.0).expand_as(wavelengths_um)
    index: Coloured | float = 1.0
    for vertex, curvature, square_radius, cauchy_a, cauchy_b in table.tolist():
        path = (vertex - pz) / z
        px, py = px + path * x, py + path * y
        slant = z - curvature * (px * x + py * y)
        square = slant * slant - curvature * curvature * (px * px + py * py)
        cosine = torch.sqrt(square.clamp(min=0.0))
        alive = alive & (z != 0.0) & (square >= 0.0)
        path = curvature * (px * px + py * py) / (slant + cosine)
        px, py, pz = px + path * x, py + path * y, vertex + path * z
        behind = cauchy_a + number(cauchy_b, wavelengths_um) / (wavelengths_um * wavelengths_um)
        ratio = index / behind
        square = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        alive = alive & (px * px + py * py <= square_radius) & (square >= 0.0)
        turn = torch.sqrt(square.clamp(min=0.0)) - ratio * cosine
        x = ratio * x - turn * curvature * px
        y = ratio * y - turn * curvature * py
        z = ratio * z + turn * (1.0 - curvature * (pz - vertex))
        index = behind
    return (px, py, pz), (x, y, z), alive
