"""Layers of a frame: EXR files of other renderers, or a staged scene that is rendered here."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from mrbokeh.images.exr_io import header_of
from mrbokeh.images.layer import Layer, clear
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.filming import FilmedLayers, Filming
from mrbokeh.scene.staging.scene_file import read_scene_file
from mrbokeh.shots.inputs import CameraSource, Description, Kept, LayerSource, Moment
from mrbokeh.stacks.exr_layers.cryptomatte import ObjectSplit
from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples, interleaved
from mrbokeh.stacks.exr_layers.sequence import ExrSequence
from mrbokeh.system.errors import InputError
from mrbokeh.video.image_sequence import HOLD, STOP, held_number, require_all_there, require_rate


@dataclass(frozen=True)
class LayerFiles:
    """Description of a still (RGBAZ.exr, the same in every frame) or numbered files (seq.%04d.exr).

    objects: names in their Cryptomatte; only these are taken, each as a layer. Empty takes all. missing: what becomes of frames without a
    file, also before the first and after the last: stop, hold or black.
    """

    path: Path
    objects: tuple[str, ...] = ()
    missing: str = STOP

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> LayerSource:  # noqa: ARG002
        return _OpenedFiles(layer_sequence(self.path, self.objects), self.missing)

    def require_all(self, numbers: Sequence[int], rate: Fraction) -> None:
        """Raise InputError if files of these frames are missing, and nothing is told to stand for them, or if they are of another rate."""
        sequence = layer_sequence(self.path)
        if sequence.is_still:
            return
        require_rate(next(iter(sequence.paths.values())), rate, "the clip")
        if self.missing == STOP:
            require_all_there(self.path, sequence.paths.keys(), numbers)


def layer_sequence(path: Path, objects: tuple[str, ...] = ()) -> ExrSequence:
    """Open one file or numbered ones, of which only some objects may be wanted."""
    return ExrSequence.of(path, ObjectSplit(objects=objects, with_rest=False) if objects else None, whole=False)


def _file_at(sequence: ExrSequence, number: int, missing: str) -> Path | None:
    """Return the file of a frame, or the one that is held; None where nothing is seen."""
    if sequence.is_still or number in sequence.paths or missing == STOP:
        return sequence.path_of(number)
    return sequence.paths[held_number(sequence.paths, number)] if missing == HOLD else None


@dataclass(frozen=True)
class AmongDeep:
    """Description of deep files, stills or numbered, and of other layers that their samples go among by depth."""

    deep: tuple[Path, ...]
    others: tuple[Description[LayerSource], ...] = ()
    missing: str = STOP

    @property
    def files(self) -> tuple[Path, ...]:
        return (*self.deep, *(path for each in self.others for path in each.files))

    def opened(self, threads: int) -> LayerSource:
        deep = [layer_sequence(path) for path in self.deep]
        return _OpenedAmong(deep, [each.opened(threads) for each in self.others], self.missing)


def sources_by_depth(files: Sequence[LayerFiles], others: Sequence[Description[LayerSource]]) -> tuple[Description[LayerSource], ...]:
    """Descriptions in the order given, unless some of the files are deep: those go among all the rest."""
    deep = [each.path for each in files if not each.objects and layer_sequence(each.path).is_deep]
    rest = (*(each for each in files if each.path not in deep), *others)
    return (AmongDeep(tuple(deep), rest, files[0].missing),) if deep else rest


def with_cryptomatte(layers: Sequence[Description[LayerSource]]) -> tuple[Path, ...]:
    """Return the files, numbered or not, of flat layers whose first frame has a Cryptomatte."""
    whole = [getattr(each, "whole", each) for each in layers]  # of a proxy
    among = [other for each in whole for other in (each.others if isinstance(each, AmongDeep) else (each,))]
    paths = [each.path for each in among if isinstance(each, LayerFiles)]
    first = {path: next(iter(layer_sequence(path).paths.values())) for path in paths}
    return tuple(path for path in paths if any(name.startswith("cryptomatte/") for name in header_of(first[path])))


class _OpenedAmong:
    def __init__(self, deep: Sequence[ExrSequence], others: Sequence[LayerSource], missing: str) -> None:
        self._deep, self._others, self._missing = deep, others, missing
        self._read, self._put = [Kept(DeepSamples.read) for _ in deep], Kept(interleaved)

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:
        samples = []
        for sequence, read in zip(self._deep, self._read, strict=True):
            path = _file_at(sequence, moment.number, self._missing)
            if path is None:
                continue
            samples.append(read(str(path)))
            _require_size(path, (samples[-1].width_px, samples[-1].height_px), moment)
        return self._put(samples, [layer for each in self._others for layer in each.layers_at(moment, cameras)])


def _require_size(path: Path, size_px: tuple[int, int], moment: Moment) -> None:
    if size_px != moment.size_px:
        sizes = f"{path} is {size_px[0]}x{size_px[1]} px but the clip is {moment.size_px[0]}x{moment.size_px[1]} px"
        raise InputError(f"{sizes}: render the layer in the size of the clip")


class _OpenedFiles:
    def __init__(self, sequence: ExrSequence, missing: str) -> None:
        self._sequence, self._missing = sequence, missing
        self._read = Kept(lambda name: sequence.reader.layers(Path(name)))

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:  # noqa: ARG002
        path = _file_at(self._sequence, moment.number, self._missing)
        if path is None:
            return [clear(moment.size_px[1], moment.size_px[0])]
        layers = self._read(str(path))
        for layer in layers:
            _require_size(path, (layer.width_px, layer.height_px), moment)
        return layers


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
    """Opened scene, filmed anew only if the camera or the scene moved."""

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
    """Return whether two cameras see the same."""
    facts = [(each.width_px, each.height_px, each.focal_px, each.principal_px) for each in (one, other)]
    return facts[0] == facts[1] and np.array_equal(one.camera_from_world, other.camera_from_world)
