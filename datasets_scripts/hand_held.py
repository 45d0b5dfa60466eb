"""The path of a camera that a hand holds over a table: it wanders slowly about a point and trembles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

# Sines of unrelated periods: (Hz, share). Breathing and swaying below 1 Hz, tremor of the hand at 6 to 11 Hz.
_SWAY = ((0.23, 1.0), (0.41, 0.5), (0.87, 0.25))
_TREMOR = ((6.1, 1.0), (8.3, 0.7), (10.9, 0.4))


@dataclass(frozen=True)
class HandHeld:
    """Looks at target_m (z into the table) from distance_m, elevation_deg above the table, and moves about that.

    sway_m, sway_deg: how far position and gaze wander. tremor_m, tremor_deg: amplitudes of the trembling.
    """

    target_m: tuple[float, float, float]
    distance_m: float = 0.6
    elevation_deg: float = 50.0
    sway_m: float = 0.06
    sway_deg: float = 3.0
    tremor_m: float = 0.0006
    tremor_deg: float = 0.06
    seed: int = 0

    def camera_from_world(self, time_s: float) -> Float64[np.ndarray, "4 4"]:
        rng = np.random.default_rng(self.seed)
        moved_m = self.sway_m * _wander(_SWAY, time_s, rng) + self.tremor_m * _wander(_TREMOR, time_s, rng)
        turned_deg = self.sway_deg * _wander(_SWAY, time_s, rng) + self.tremor_deg * _wander(_TREMOR, time_s, rng)
        up = np.deg2rad(self.elevation_deg)
        # Below the sheet's lower edge (+y) and above the table (-z), looking at the target; x stays to the right.
        base = Rotation.from_euler("x", up - np.pi / 2).as_matrix()
        centre = np.asarray(self.target_m) + self.distance_m * np.array([0.0, np.cos(up), -np.sin(up)]) + moved_m
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(turned_deg, degrees=True).as_matrix() @ base
        pose[:3, 3] = -pose[:3, :3] @ centre
        return pose


def _wander(sines: tuple[tuple[float, float], ...], time_s: float, rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    phases = rng.uniform(0, 2 * np.pi, (len(sines), 3))
    return np.sum([share * np.sin(2 * np.pi * rate * time_s + phase) for (rate, share), phase in zip(sines, phases, strict=True)], axis=0)
