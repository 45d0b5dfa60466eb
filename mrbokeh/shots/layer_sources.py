"""Layers of a frame from EXR files of other renderers (of a scene rendered here: mrbokeh.shots.scene_layers)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.images.layer import Layer
from mrbokeh.shots.hooks import CameraSource, Description, LayerSource, Moment
from mrbokeh.shots.kept import Kept
from mrbokeh.stacks.exr_layers.cryptomatte import ObjectSplit
from mrbokeh.stacks.exr_layers.deep_interleaved import interleaved
from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples, DeepSurfaces
from mrbokeh.stacks.exr_layers.sequence import ExrSequence
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class LayerFiles:
    """Description of a still (RGBAZ.exr, the same in every frame) or numbered files (seq.%04d.exr).

    objects: names in their Cryptomatte; only these are taken, each as a layer. Empty takes all.
    """

    path: Path
    objects: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def opened(self, threads: int) -> LayerSource:  # noqa: ARG002
        return _OpenedFiles(layer_sequence(self.path, self.objects))


def layer_sequence(path: Path, objects: tuple[str, ...] = ()) -> ExrSequence:
    """One file or numbered ones, of which only some objects may be wanted."""
    return ExrSequence.of(path, ObjectSplit(objects=objects, with_rest=False) if objects else None)


@dataclass(frozen=True)
class AmongDeep:
    """Description of deep files, stills or numbered, and of other layers that their samples go among by depth."""

    deep: tuple[Path, ...]
    others: tuple[Description[LayerSource], ...] = ()

    @property
    def files(self) -> tuple[Path, ...]:
        return (*self.deep, *(path for each in self.others for path in each.files))

    def opened(self, threads: int) -> LayerSource:
        return _OpenedAmong([layer_sequence(path) for path in self.deep], [each.opened(threads) for each in self.others])


def sources_by_depth(files: Sequence[LayerFiles], others: Sequence[Description[LayerSource]]) -> tuple[Description[LayerSource], ...]:
    """Descriptions in the order given, unless some of the files are deep: those go among all the rest."""
    deep = [each.path for each in files if not each.objects and layer_sequence(each.path).is_deep]
    rest = (*(each for each in files if each.path not in deep), *others)
    return (AmongDeep(tuple(deep), rest),) if deep else rest


class _OpenedAmong:
    def __init__(self, deep: Sequence[ExrSequence], others: Sequence[LayerSource]) -> None:
        self._deep, self._others = deep, others
        self._read, self._put = [Kept(_samples) for _ in deep], Kept(interleaved)

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:
        samples = []
        for sequence, read in zip(self._deep, self._read, strict=True):
            path = sequence.path_of(moment.number)
            samples.append(read(sequence, str(path)))
            _require_size(path, (samples[-1].width_px, samples[-1].height_px), moment)
        return self._put(samples, [layer for each in self._others for layer in each.layers_at(moment, cameras)])


def _samples(sequence: ExrSequence, path: str) -> DeepSamples:
    assert isinstance(sequence.reader, DeepSurfaces)
    return sequence.reader.samples(path)


def _require_size(path: Path, size_px: tuple[int, int], moment: Moment) -> None:
    if size_px != moment.size_px:
        sizes = f"{path} is {size_px[0]}x{size_px[1]} px but the clip is {moment.size_px[0]}x{moment.size_px[1]} px"
        raise InputError(f"{sizes}: render the layer in the size of the clip")


class _OpenedFiles:
    def __init__(self, sequence: ExrSequence) -> None:
        self._sequence = sequence
        self._read = Kept(lambda name: sequence.reader.layers(Path(name)))

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:  # noqa: ARG002
        path = self._sequence.path_of(moment.number)
        layers = self._read(str(path))
        for layer in layers:
            _require_size(path, (layer.width_px, layer.height_px), moment)
        return layers
