"""Layers of a frame: EXR files of other renderers, or a staged scene rendered here."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrbokeh.camera import Camera
from mrbokeh.errors import InputError
from mrbokeh.exr_layers.sequence import ExrSequence
from mrbokeh.layer import Layer
from mrbokeh.scene import Scene
from mrbokeh.scene.base import SceneRenderer
from mrbokeh.scene.choose import scene_renderer
from mrbokeh.shots.hooks import Distorter, LayerSource, Moment
from mrbokeh.shots.kept import Kept
from mrbokeh.staging.assets import Assets
from mrbokeh.staging.scene_description import SceneDescription
from mrbokeh.staging.scene_file import read_scene_file
from mrbokeh.staging.staged_layers import staged_layers
from mrbokeh.staging.staged_scene import StagedScene


@dataclass(frozen=True)
class LayerFiles:
    """Description of a still (RGBAZ.exr, the same in every frame) or numbered files (seq.%04d.exr)."""

    path: Path

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> LayerSource:  # noqa: ARG002
        return _OpenedFiles(ExrSequence.of(self.path))


class _OpenedFiles:
    def __init__(self, sequence: ExrSequence) -> None:
        self._sequence = sequence
        self._read = Kept(lambda name: sequence.reader.layers(Path(name)))

    def layers_at(self, moment: Moment, camera: Camera | None) -> Sequence[Layer]:  # noqa: ARG002
        path = self._sequence.path_of(moment.number)
        layers = self._read(str(path))
        for layer in layers:
            if (layer.width_px, layer.height_px) != moment.size_px:
                sizes = f"{path} is {layer.width_px}x{layer.height_px} px but the clip is {moment.size_px[0]}x{moment.size_px[1]} px"
                raise InputError(f"{sizes}: render the layer in the size of the clip")
        return layers


@dataclass(frozen=True)
class SceneLayers:
    """Description of a scene file (mrbokeh.staging) and the backend that renders it; begin_s: when in the clip its animations start.

    distorter: of the plate's lens, or None for a pinhole.
    """

    path: Path
    backend: str = "auto"
    begin_s: float = 0.0
    distorter: Distorter | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        return read_scene_file(self.path).files

    def opened(self, threads: int) -> LayerSource:
        return _OpenedScene(self, read_scene_file(self.path), scene_renderer(self.backend, threads))


class _OpenedScene:
    """Rendered anew only where the camera or the scene moved."""

    def __init__(self, described: SceneLayers, description: SceneDescription, backend: SceneRenderer) -> None:
        self._described, self._backend = described, backend
        self._staged = StagedScene.load(description, Assets())
        self._last: tuple[Scene, Camera, Sequence[Layer]] | None = None

    def layers_at(self, moment: Moment, camera: Camera | None) -> Sequence[Layer]:
        if camera is None:
            raise InputError(f"to render {self._described.path} a camera is needed: give --camera with a fixed camera or a track")
        time_s = moment.time_s - self._described.begin_s
        scene, last = self._staged.scene_at(time_s), self._last
        if last is None or last[0] is not scene or not same_view(last[1], camera):
            last = self._last = scene, camera, self._render(camera, time_s)
        return last[2]

    def _render(self, camera: Camera, time_s: float) -> Sequence[Layer]:
        distorter = self._described.distorter
        if distorter is None:
            return staged_layers(self._staged, camera, self._backend, time_s)
        overscan = distorter.overscan_camera(camera)
        layers = staged_layers(self._staged, overscan, self._backend, time_s)
        return [distorter.distorted(layer, overscan, camera) for layer in layers]


def same_view(one: Camera, other: Camera) -> bool:
    """Whether two cameras see the same."""
    facts = [(each.width_px, each.height_px, each.focal_px, each.principal_px) for each in (one, other)]
    return facts[0] == facts[1] and np.array_equal(one.camera_from_world, other.camera_from_world)
