"""Layers of a frame: a staged scene, rendered here."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.filming import FilmedLayers, Filming
from mrbokeh.scene.staging.scene_file import read_scene_file
from mrbokeh.shots.hooks import CameraSource, LayerSource, Moment
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class SceneLayers:
    """Description of a scene file (mrbokeh.scene.staging) and how it is filmed; begin_s: when in the clip its animations start."""

    path: Path
    filming: Filming = field(default_factory=Filming)
    begin_s: float = 0.0

    @property
    def files(self) -> tuple[Path, ...]:
        return read_scene_file(self.path).files

    def opened(self, threads: int) -> LayerSource:
        return _OpenedScene(self, FilmedLayers(self.filming, read_scene_file(self.path), threads))


class _OpenedScene:
    """Filmed anew only where the camera or the scene moved."""

    def __init__(self, described: SceneLayers, filmed: FilmedLayers) -> None:
        self._described, self._filmed = described, filmed
        self._last: tuple[Camera, Sequence[Layer]] | None = None

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:
        if cameras is None:
            raise InputError(f"to render {self._described.path} a camera is needed: give --camera with a fixed camera or a track")
        camera, last = cameras.camera_at(moment), self._last
        if last is None or self._filmed.changes_by_itself or not same_view(last[0], camera):
            last = self._last = camera, self._film(moment, cameras)
        return last[1]

    def _film(self, moment: Moment, cameras: CameraSource) -> Sequence[Layer]:
        begin_s = moment.time_s - self._described.begin_s
        return self._filmed.at(lambda time_s: cameras.camera_at(moment, time_s - begin_s), begin_s)


def same_view(one: Camera, other: Camera) -> bool:
    """Whether two cameras see the same."""
    facts = [(each.width_px, each.height_px, each.focal_px, each.principal_px) for each in (one, other)]
    return facts[0] == facts[1] and np.array_equal(one.camera_from_world, other.camera_from_world)
