"""Light tracing by torch: on an NVIDIA GPU, or on any processor that torch runs on (models of Leimkuehler et al. 2018, Section 5.1).

Twins of the compiled loops (`_physical_lens_numba`, `_rays_numba`), a step of theirs at a time for all rays or photons of a block. They
take the same quasi-random points, and photons the same random numbers, in double precision and in the same order of operations. A ray
then lands where the compiled one lands but for rounding (torch's square roots, sines and logarithms may differ in the last bit): within
1e-13 mm behind the double Gauss, so that about one ray in a million million takes the pixel beside. Light is added up in whole numbers
(`_sums`), which come out the same in any order. A bank is therefore the same to float32 on any device, and a half-built one goes on on
another.

What does not grow with the rays stays on the CPU: the points themselves, the search for chief rays and windows, the turning of
rings into pixels.

torch comes with the extra `train`; without it, importing this package says so.
"""

try:
    import torch
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

import math

import numpy as np
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from mrbokeh.psf_models.torch_tracing._rays import LandedRays, number, on, summed, trace_capsule, trace_lens, trace_picture
from mrbokeh.system.torch_device import device_named

__all__ = ["LandedRays", "photons_in_rings", "trace_capsule", "trace_lens", "trace_photons", "trace_picture"]


def _signed(number: int) -> int:
    """Return 64 bits as torch holds them."""
    return (number + (1 << 63)) % (1 << 64) - (1 << 63)


_GOLDEN, _FIRST, _SECOND = map(_signed, (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
_TO_UNIT = 1.0 / 9007199254740992.0

States = Int64[Tensor, " photons"]
Photons = Float64[Tensor, " photons"]
Vectors = Float64[Tensor, "3 photons"]


def _shifted(z: States, bits: int) -> States:
    """Shift to the right, with zeros from the left."""
    return (z >> bits) & ((1 << (64 - bits)) - 1)


def first_states(first: int, count: int, seed: int, device: torch.device) -> States:
    """Return the states of photon `first` and following: see `start_photon`."""
    photons = torch.arange(first, first + count, dtype=torch.int64, device=device)
    z = photons * _SECOND + _signed(seed * _FIRST)
    z = (z ^ _shifted(z, 33)) * _SECOND
    return z ^ _shifted(z, 29)


def uniform(states: States) -> tuple[States, Photons]:
    """Return (the states after, the next number in [0, 1) of each): SplitMix64; whole numbers wrap round as unsigned ones do."""
    states = states + _GOLDEN
    z = (states ^ _shifted(states, 30)) * _FIRST
    z = (z ^ _shifted(z, 27)) * _SECOND
    return states, _shifted(z ^ _shifted(z, 31), 11).to(torch.float64) * _TO_UNIT


def _free_paths(states: States, density_per_m: float, majorant_per_m: float) -> tuple[States, Photons]:
    """Fly all photons tentatively until each has had a real collision: see `free_path`."""
    paths_m = torch.zeros(len(states), dtype=torch.float64, device=states.device)
    flying = torch.ones(len(states), dtype=torch.bool, device=states.device)
    states = states.clone()
    while bool(flying.any()):
        moved, first = uniform(states)
        moved, second = uniform(moved)
        paths_m = torch.where(flying, paths_m - torch.log(1.0 - first) / number(majorant_per_m, first), paths_m)
        states = torch.where(flying, moved, states)
        flying = flying & ~(second * majorant_per_m < density_per_m)
    return states, paths_m


def _scattering_cosines(anisotropy: float, shares: Photons) -> Photons:
    """See `scattering_cosine`."""
    if abs(anisotropy) < 1e-4:
        return 2.0 * shares - 1.0
    part = number(1.0 - anisotropy * anisotropy, shares) / (1.0 - anisotropy + 2.0 * anisotropy * shares)
    return ((1.0 + anisotropy * anisotropy - part * part) / number(2.0 * anisotropy, shares)).clamp(-1.0, 1.0)


def _turned(direction: Vectors, cosine: Photons, azimuth: Photons) -> Vectors:
    """See `turn`."""
    x, y, z = direction
    sine = torch.sqrt((1.0 - cosine * cosine).clamp(min=0.0))
    sign = torch.where(z >= 0.0, 1.0, -1.0).to(torch.float64)
    scale = -1.0 / (sign + z)
    across = x * y * scale
    along, aside = sine * torch.cos(azimuth), sine * torch.sin(azimuth)
    new_x = along * (1.0 + sign * x * x * scale) + aside * across + cosine * x
    new_y = along * sign * across + aside * (sign + y * y * scale) + cosine * y
    new_z = -along * sign * x - aside * y + cosine * z
    return torch.stack([new_x, new_y, new_z]) / torch.sqrt(new_x * new_x + new_y * new_y + new_z * new_z)


def _rest_m(radii_m: Photons, place: Vectors, heading: Vectors) -> Photons:
    """Return the distance to the surface of the ball."""
    along = place[0] * heading[0] + place[1] * heading[1] + place[2] * heading[2]
    inside = (radii_m * radii_m - (place[0] * place[0] + place[1] * place[1] + place[2] * place[2])).clamp(min=0.0)
    root = torch.sqrt(along * along + inside)
    return torch.where(along < 0.0, root - along, inside / (root + along).clamp(min=1e-300))


def trace_photons(
    device: str,
    first: int,
    seed: int,
    radii_m: Float64[np.ndarray, " photons"],
    density_per_m: float,
    majorant_per_m: float,
    anisotropy: float,
) -> tuple[Photons, Int64[Tensor, " photons"]]:
    """Return (cosines between headings and normals, collisions): see `_rays_numba.trace_photons`. Finished photons leave the loop."""
    radii = on(device_named(device), radii_m)
    cosines, collisions = torch.ones_like(radii), torch.zeros_like(radii, dtype=torch.int64)
    if density_per_m <= 0.0:
        return cosines, collisions
    still = torch.arange(len(radii), device=radii.device)
    states, place = (
        first_states(first, len(radii), seed, radii.device),
        torch.zeros((3, len(radii)), dtype=torch.float64, device=radii.device),
    )
    heading = torch.zeros_like(place)
    heading[2] = 1.0
    step = 0
    while len(still):
        states, paths_m = _free_paths(states, density_per_m, majorant_per_m)
        rest_m = _rest_m(radii[still], place, heading)
        out: Bool[Tensor, " photons"] = paths_m >= rest_m
        place = place + torch.where(out, rest_m, paths_m) * heading
        outward = place[0] * heading[0] + place[1] * heading[1] + place[2] * heading[2]
        if step:
            cosines[still[out]] = (outward[out] / radii[still[out]]).clamp(max=1.0)
        collisions[still[out]] = step
        step += 1
        states, place, heading, still = states[~out], place[:, ~out], heading[:, ~out], still[~out]
        states, share = uniform(states)
        states, azimuth = uniform(states)
        heading = _turned(heading, _scattering_cosines(anisotropy, share), 2.0 * math.pi * azimuth)
    return cosines, collisions


def photons_in_rings(
    cosines: Photons,
    collisions: Int64[Tensor, " photons"],
    albedo: Float64[np.ndarray, " channels"],
    focal_px: float,
    ring_px: float,
    rings: int,
) -> Float64[np.ndarray, "rings channels"]:
    """Sort photons into rings as `_rays_numba.add_to_rings` does."""
    sine = torch.sqrt((1.0 - cosines * cosines).clamp(min=0.0))
    ring = torch.where(cosines > 0.0, focal_px * sine / (cosines * ring_px), math.inf)
    caught = ring < rings
    where, times = ring[caught].to(torch.int64), collisions[caught].to(torch.float64)
    return np.stack([summed(where, each**times, rings) for each in albedo.tolist()], axis=1)
