"""CaptureBundle: one moment of the viewfinder kept as files, to be composited again at full quality.

NAME/bundle.json     what follows, the camera with its pose, when, and what the stream looked like then
NAME/plate.png       the camera's picture as it came
NAME/layer_0.exr ... the virtual layers in focus (R, G, B, A, Z), front first, in the plate's size
NAME/lens.json       the lens as it was focused
NAME/preview.jpg     what the viewfinder showed
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_io import read_image, read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera, camera_from_json, camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens, write_lens
from mrbokeh.system.atomic_files import atomic_folder, read_json, write_json
from mrbokeh.system.errors import InputError

FILE_NAME = "bundle.json"
FORMAT, VERSION = "mrbokeh-capture-bundle", 1


@dataclass(frozen=True)
class CaptureBundle:
    """Moment of the viewfinder, read back.

    plate_rgb: (H, W, 3) linear. layers: in focus, front first, (H, W). camera: of the plate, with its pose in the scene's world.

    renderer: what blurred the stream, a name or an .onnx. facts: JSON values about the moment (time, tracking, stages).
    """

    plate_rgb: Float32[np.ndarray, "height width 3"]
    layers: tuple[Layer, ...]
    lens: Lens
    camera: Camera
    renderer: str
    facts: Mapping[str, Any] = field(default_factory=dict)


def write_bundle(
    folder: Path,
    plate_png: bytes,
    preview_jpg: bytes,
    layers: Sequence[Layer],
    lens: Lens,
    camera: Camera,
    renderer: str,
    facts: Mapping[str, Any],
) -> None:
    """Write all files at once: the folder appears when it is whole. Raises InputError if it exists."""
    with atomic_folder(folder) as temporary:
        (temporary / "plate.png").write_bytes(plate_png)
        (temporary / "preview.jpg").write_bytes(preview_jpg)
        names = [f"layer_{index}.exr" for index in range(len(layers))]
        for name, layer in zip(names, layers, strict=True):
            write_layer(temporary / name, layer)
        write_lens(temporary / "lens.json", lens)
        head = {"format": FORMAT, "version": VERSION, "plate": "plate.png", "layers": names, "lens": "lens.json", "renderer": renderer}
        write_json(temporary / FILE_NAME, head | {"camera": camera_to_json(camera), "facts": dict(facts)})


def is_bundle(folder: Path) -> bool:
    return (folder / FILE_NAME).is_file()


def read_bundle(folder: Path) -> CaptureBundle:
    """Read a bundle. Raises InputError if anything of it is missing or not of one size."""
    head = read_json(folder / FILE_NAME, "a capture bundle of the viewfinder")
    if not isinstance(head, dict) or head.get("format") != FORMAT or head.get("version") != VERSION:
        raise InputError(f"{folder / FILE_NAME}: expected format {FORMAT!r} version {VERSION}: capture again")
    names = (head.get("plate"), head.get("lens"), *head.get("layers", ()))
    if not all(isinstance(name, str) and Path(name).name == name for name in names):
        raise InputError(f"{folder / FILE_NAME}: expected names of files beside it for plate, lens and layers, got {names}")
    plate = read_image(folder / head["plate"])
    layers = tuple(read_layer(folder / name) for name in head["layers"])
    camera = camera_from_json(head.get("camera", {}), str(folder / FILE_NAME))
    sizes = {plate.shape[:2], (camera.height_px, camera.width_px), *(layer.alpha.shape for layer in layers)}
    if len(sizes) > 1:
        raise InputError(f"{folder}: expected plate, camera and layers of one size, got {sorted(sizes)} (height, width): capture again")
    return CaptureBundle(
        plate_rgb=plate,
        layers=layers,
        lens=read_lens(folder / head["lens"]),
        camera=camera,
        renderer=str(head.get("renderer", "polygon")),
        facts=head.get("facts", {}),
    )
