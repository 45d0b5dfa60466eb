"""Rays of the simple, combined, stylized and physical models on a device: twins of the compiled loops, for all rays of a block at once.

`trace_lens`, `trace_capsule` and `trace_picture` take the arguments of the compiled ones after the device; each adds a block of rays to a
kernel and returns its light. Light is added up in bins of whole numbers, which come out the same in any order.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Shaped
from torch import Tensor

from mrbokeh.psf_models._lens_beam import BANDS_UM, LensBeam
from mrbokeh.system.torch_device import device_named

_BITS = 61


def on(device: torch.device, array: Shaped[np.ndarray, "..."]) -> Shaped[Tensor, "..."]:
    return torch.from_numpy(np.ascontiguousarray(array)).to(device)


def number(value: float, like: Float64[Tensor, "..."]) -> Float64[Tensor, ""]:
    """Return a number as a tensor, for divisions that are rounded once.

    With a plain number torch multiplies by a reciprocal: always if the number is the dividend, on GPUs if it is the divisor too.
    """
    return torch.full((), value, dtype=torch.float64, device=like.device)


def summed(bins: Int64[Tensor, " rays"], weights: Float64[Tensor, " rays"], count: int) -> Float64[np.ndarray, " count"]:
    """Sum the weights in each of `count` bins, to 2**-61 of rays x the largest weight: whole numbers of 64 bits."""
    largest = float(weights.abs().max()) if len(weights) else 0.0
    exponent = _BITS - math.frexp(max(largest * len(weights), 1e-200))[1]
    sums = torch.zeros(count, dtype=torch.int64, device=bins.device)
    sums.index_add_(0, bins, (weights * math.ldexp(1.0, exponent)).round().to(torch.int64))
    return sums.cpu().numpy() * math.ldexp(1.0, -exponent)


def pixels(x: Float64[Tensor, "*rays"], y: Float64[Tensor, "*rays"], size: int) -> tuple[Int64[Tensor, "*rays"], Bool[Tensor, "*rays"]]:
    """Return (number of the pixel of a picture `size` wide and high, row by row, and whether the place lies in it)."""
    column, row = x.floor(), y.floor()
    inside = (row >= 0.0) & (row < size) & (column >= 0.0) & (column < size)
    return torch.where(inside, row * size + column, 0.0).to(torch.int64), inside


Rays = Float64[Tensor, " rays"]
Kernel = Float64[np.ndarray, "size size"]


def trace_lens(
    device: str,
    kernel: Kernel,
    low_px: float,
    high_px: float,
    shares: Float64[np.ndarray, "rays 3"],
    extent: float,
    edges: Float64[np.ndarray, "edges 5"],
    starts: Int64[np.ndarray, " bands_and_end"],
) -> float:
    """Trace rays as `_rays_numba.trace_lens` does."""
    where = device_named(device)
    first, second, third = on(where, shares.T)
    u, v = (2.0 * first - 1.0) * extent, (2.0 * second - 1.0) * extent
    weights = _opening_at(u, v, on(where, edges), on(where, starts), extent, int(np.diff(starts).max()))
    half_px, centre = 0.5 * (low_px + (high_px - low_px) * third), 0.5 * len(kernel)
    return _added(kernel, centre + half_px * u, centre + half_px * v, weights)


def _opening_at(
    x: Rays, y: Rays, edges: Float64[Tensor, "edges 5"], starts: Int64[Tensor, " bands_and_end"], extent: float, most: int
) -> Rays:
    """Return the weight of the opening at each ray: the first edge of its band, then the second, up to the most that a band has."""
    bands = len(starts) - 1
    band = ((y + extent) * bands / number(2.0 * extent, y)).to(torch.int64).clamp(0, bands - 1)
    start, end = starts[band], starts[band + 1]
    total = torch.zeros_like(x)
    for turn in range(most):
        edge = start + turn
        x0, y0, x1, y1, weight = edges[edge.clamp(max=len(edges) - 1)].unbind(1)
        crossed = (edge < end) & ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        total += torch.where(crossed, weight, 0.0)
    return total


def trace_capsule(device: str, kernel: Kernel, box: Float64[np.ndarray, "2 2"], shares: Float64[np.ndarray, "rays 5"]) -> float:
    """Trace rays as `_rays_numba.trace_capsule` does."""
    first, second, third, fourth, fifth = on(device_named(device), shares.T)
    radius, angle = torch.sqrt(first), 2.0 * math.pi * second
    (low_px, high_px), (shortest_px, longest_px) = box.tolist()
    half_px = 0.5 * (low_px + (high_px - low_px) * third)
    motion_px = shortest_px + (longest_px - shortest_px) * fourth
    centre = 0.5 * len(kernel)
    x = centre + half_px * radius * torch.cos(angle) + motion_px * (fifth - 0.5)
    return _added(kernel, x, centre + half_px * radius * torch.sin(angle), torch.ones_like(x))


def trace_picture(
    device: str,
    kernel: Kernel,
    low_px: float,
    high_px: float,
    shares: Float64[np.ndarray, "rays 3"],
    origin: Float64[np.ndarray, "2"],
    unit: float,
    rows: Float64[np.ndarray, " height_and_end"],
    columns: Float64[np.ndarray, "height width_and_end"],
) -> float:
    """Trace rays as `_rays_numba.trace_picture` does."""
    where = device_named(device)
    first, second, third = on(where, shares.T)
    y = _inverted(on(where, rows[None]), torch.zeros_like(first, dtype=torch.int64), first)
    x = _inverted(on(where, columns), y.to(torch.int64).clamp(max=len(columns) - 1), second)
    half_px, centre = 0.5 * (low_px + (high_px - low_px) * third) * unit, 0.5 * len(kernel)
    return _added(kernel, centre + half_px * (x - float(origin[0])), centre + half_px * (y - float(origin[1])), torch.ones_like(x))


def _inverted(cumulative: Float64[Tensor, "lines points"], line: Int64[Tensor, " rays"], share: Rays) -> Rays:
    """Return where the rising polyline of a ray's line, over 0, 1, 2, ..., reaches its share; found by halving."""
    width = cumulative.shape[1]
    values, start = cumulative.reshape(-1), line * width
    low, high = torch.zeros_like(line), torch.full_like(line, width)
    for _ in range(width.bit_length()):  # values below `low` are at most the share, those from `high` on are more
        middle = (low + high) // 2
        beyond = values[start + middle.clamp(max=width - 1)] > share
        low, high = torch.where(beyond | (low >= high), low, middle + 1), torch.where(beyond, middle, high)
    low = (low - 1).clamp(0, width - 2)
    rise = values[start + low + 1] - values[start + low]
    part = ((share - values[start + low]) / rise).clamp(max=1.0)
    return low + torch.where(rise > 0.0, part, 0.0)


def _added(kernel: Kernel, x: Rays, y: Rays, weights: Rays) -> float:
    """Add rays that land at (x, y), counted from the corner of the kernel. Returns their light."""
    size = len(kernel)
    pixel, inside = pixels(x, y, size)
    light = summed(pixel, torch.where(inside, weights, 0.0), size * size)
    kernel += light.reshape(size, size)
    return float(light.sum())


Vectors = tuple[Rays, Rays, Rays]
Coloured = Float64[Tensor, "colours rays"]
ColouredVectors = tuple[Coloured, Coloured, Coloured]


class LandedRays:
    """Block of rays of all colours on the sensor. Arguments after the beam are those of `LensBeam.trace`.

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
        """Return how far from the chief ray's place, along x or y, the farthest light lands."""
        lit = self.weights > 0.0
        return max(float(torch.where(lit, each.abs(), 0.0).max()) for each in self.landings)

    def picture(self, size: int, mm_per_px: float) -> Float64[np.ndarray, "size size colours"]:
        """Sum the rays in pixels as `_physical_lens_numba.add_landings` does."""
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
    """Return (x on the sensor, (x and z on the first surface, direction x and z)), linear between the nodes."""
    last = len(chiefs) - 1
    node = field.to(torch.int64).clamp(max=max(last - 1, 0))
    part = (field - node)[:, None]
    middle, x, z, along_x, along_z = ((1.0 - part) * chiefs[node] + part * chiefs[(node + 1).clamp(max=last)]).unbind(1)
    length = torch.sqrt(along_x * along_x + along_z * along_z)
    return middle, torch.stack([x, z, along_x / length, along_z / length])


def _from_points(
    chief: Float64[Tensor, "4 rays"], front_mm: float, per_mm: Rays, a_mm: Rays, b_mm: Rays
) -> tuple[tuple[Vectors, Vectors], Rays, Rays]:
    """Return ((places, directions), square of the ray's length relative to the chief ray's, that length): see `trace_point`."""
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
    """Return (places on the last surface, directions behind it, whether the ray got through): see `trace_ray`, with rims, from air.

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
