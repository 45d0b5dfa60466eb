"""What every way of turning one EXR file into layers is."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from mrbokeh.images.layer import Layer


@runtime_checkable
class LayerReader(Protocol):
    """How one file of a render is to be understood; its settings are its constructor's."""

    def layers(self, path: Path | str) -> list[Layer]:
        """Sharp layers, front first, linear Rec.709, depth in metres. Raises InputError where the file lacks what is asked for."""
        ...
