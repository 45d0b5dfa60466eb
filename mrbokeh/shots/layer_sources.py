"""Layers of a frame from EXR files of other renderers (of a scene rendered here: mrbokeh.shots.scene_layers)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.errors import InputError
from mrbokeh.exr_layers.object_split import ObjectSplit
from mrbokeh.exr_layers.sequence import ExrSequence
from mrbokeh.layer import Layer
from mrbokeh.shots.hooks import CameraSource, LayerSource, Moment
from mrbokeh.shots.kept import Kept


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


class _OpenedFiles:
    def __init__(self, sequence: ExrSequence) -> None:
        self._sequence = sequence
        self._read = Kept(lambda name: sequence.reader.layers(Path(name)))

    def layers_at(self, moment: Moment, cameras: CameraSource | None) -> Sequence[Layer]:  # noqa: ARG002
        path = self._sequence.path_of(moment.number)
        layers = self._read(str(path))
        for layer in layers:
            if (layer.width_px, layer.height_px) != moment.size_px:
                sizes = f"{path} is {layer.width_px}x{layer.height_px} px but the clip is {moment.size_px[0]}x{moment.size_px[1]} px"
                raise InputError(f"{sizes}: render the layer in the size of the clip")
        return layers
