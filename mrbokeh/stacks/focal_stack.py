"""FocalStack: one viewpoint photographed at many focus distances, and the folder that holds it.

Pictures are stored in linear white-balanced camera RGB (1.0 is the raw white of green); `rec709_from_camera` leads from
there to Rec.709, and is None where the pictures are Rec.709 already (JPEG, EXR). Methods named camera_rgb give what is stored.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.images.camera_rgb import Matrix3x3, SliceMasks, matrix3x3, read_camera_rgb, read_masks, read_slice_masks, write_camera_rgb
from mrbokeh.images.color import convert
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.optics.camera import Camera, camera_from_json, camera_to_json
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError, require_file

FORMAT = "mrbokeh-focal-stack"
VERSION = 2
FILE_NAME = "stack.json"
METRES = "metres"
"""Key in a stack's metadata: what is known of its metres, see `mrbokeh.stacks.guessed_metres`."""
DEPTH_SOURCE, FROM_FOCUS = "depth_source", "focus"
"""Key in a stack's metadata: where depth.exr and all_in_focus.exr come from; FROM_FOCUS after merging."""
GROWTH, GROWTH_WIDTH = "px_per_dioptre", "px_per_dioptre_width_px"
"""Keys in a slice's metadata: how fast its blur grows before registration enlarges it, in a picture so wide."""


@dataclass(frozen=True)
class Slice:
    """Photograph of a stack.

    path: relative to the folder of the stack; linear EXR in the stack's camera RGB.
    focus_distance_m: from the lens to the plane in focus, or None where nobody knows.
    scale: how much registration enlarged the slice to match the reference (1 where it did nothing).
    metadata: what the source file told (exposure_time_s, iso, source, ...).
    """

    path: str
    focus_distance_m: float | None
    scale: float = 1.0
    metadata: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FocalStack:
    """Folder with slices, and once merged an all-in-focus image and depth. Pictures are read when asked for.

    lens: the lens with the focus of the reference slice, or None where focal length, f-number or sensor are unknown.
    camera: intrinsics of the registered pictures, or None.
    reference: the slice whose geometry the others were registered to. registered: the slices share it, as the all-in-focus image does.
    rec709_from_camera: linear Rec.709 from the camera RGB in which slices and all-in-focus image are stored; None: they are Rec.709.
    """

    folder: Path
    slices: tuple[Slice, ...]
    lens: Lens | None = None
    camera: Camera | None = None
    reference: int = 0
    registered: bool = False
    merged: bool = False
    metadata: dict[str, Any] = field(default_factory=dict)
    rec709_from_camera: Matrix3x3 | None = None

    def __len__(self) -> int:
        return len(self.slices)

    @property
    def focus_distances_m(self) -> tuple[float | None, ...]:
        """Return the focus distance of each slice in metres from the lens, None where it is unknown."""
        return tuple(each.focus_distance_m for each in self.slices)

    @property
    def is_metric(self) -> bool:
        """Return whether every focus distance is known, so that depth is in metres; else it is the index of the sharpest slice."""
        return all(distance is not None for distance in self.focus_distances_m)

    @property
    def metres_known(self) -> bool:
        """Return False if merging guessed metres because focus distances are unknown; circles of confusion are measured all the same."""
        return bool((self.metadata.get(METRES) or {}).get("known", True))

    def slice_camera_rgb(self, index: int) -> Float32[np.ndarray, "height width 3"]:
        """Read a slice as it is stored: linear, white-balanced camera RGB."""
        return read_camera_rgb(self.folder / self.slices[index].path)

    def iter_camera_rgb(self) -> Iterator[Float32[np.ndarray, "height width 3"]]:
        """Read the slices one after the other in camera RGB."""
        return (self.slice_camera_rgb(index) for index in range(len(self)))

    def slice_rgb(self, index: int) -> Float32[np.ndarray, "height width 3"]:
        """Read linear Rec.709; for strong colours of the camera's own a channel may be negative."""
        return self.to_rec709(self.slice_camera_rgb(index))

    def iter_rgb(self) -> Iterator[Float32[np.ndarray, "height width 3"]]:
        """Read the slices one after the other in linear Rec.709."""
        return (self.slice_rgb(index) for index in range(len(self)))

    def slice_masks(self, index: int) -> SliceMasks:
        """Read where a slice has data, and where it is clipped."""
        return read_slice_masks(self.folder / self.slices[index].path)

    def to_rec709(self, camera_rgb: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
        """Convert from the camera RGB of this stack to linear Rec.709."""
        return camera_rgb if self.rec709_from_camera is None else convert(camera_rgb, np.array(self.rec709_from_camera))

    @property
    def all_in_focus_path(self) -> Path:
        return self.folder / "all_in_focus.exr"

    @property
    def depth_path(self) -> Path:
        return self.folder / "depth.exr"

    @property
    def exclusion_path(self) -> Path:
        return self.folder / "exclusion.exr"

    def all_in_focus_camera_rgb(self) -> Float32[np.ndarray, "height width 3"]:
        """Read the all-in-focus picture in camera RGB. Raises InputError if the stack is not merged."""
        self._require_merged()
        return read_camera_rgb(self.all_in_focus_path)

    def all_in_focus(self) -> Float32[np.ndarray, "height width 3"]:
        """Read the all-in-focus picture in linear Rec.709. Raises InputError if the stack is not merged."""
        return self.to_rec709(self.all_in_focus_camera_rgb())

    def exclusions(self) -> dict[str, Bool[np.ndarray, "height width"]]:
        """Read (H, W) masks of pixels not to learn from, by reason: moving, saturated, border, low_confidence, board; {} if unknown."""
        return read_masks(self.exclusion_path)

    def depth_m(self) -> Float32[np.ndarray, "height width"]:
        """Read (H, W) metres along the optical axis. Raises InputError if focus distances are unknown."""
        if not self.is_metric:
            raise InputError(
                f"{self.folder} has no depth in metres because its focus distances are unknown: add them to lens.toml and ingest again"
            )
        return self._depth_channel("Z")

    def focus_index(self) -> Float32[np.ndarray, "height width"]:
        """Read (H, W) the (fractional) index of the slice in which each pixel is sharp."""
        return self._depth_channel("focus_index")

    def depth_confidence(self) -> Float32[np.ndarray, "height width"]:
        """Read (H, W) in [0, 1]: how far the depth of a pixel can be trusted; 0 is a guess from its neighbours."""
        return self._depth_channel("confidence")

    def depth_valid(self, least_confidence: float = 0.1) -> Bool[np.ndarray, "height width"]:
        """Return (H, W) where the depth can be trusted that much."""
        return self.depth_confidence() >= least_confidence

    def stated_lens_of(self, index: int) -> Lens:
        """Return the lens as it was focused for one slice, with the f-number that the camera states."""
        distance = self.slices[index].focus_distance_m
        if self.lens is None or distance is None:
            raise InputError(
                f"{self.folder} does not know its lens and focus distances: give focal_length_mm, f_number, sensor_width_mm and "
                f"focus_distances_m in a lens.toml beside the photographs and ingest again"
            )
        return self.lens.focused_at(distance)

    def lens_of(self, index: int) -> Lens:
        """Return the lens of one slice; after `mrbokeh capture scale` calibrated its blur, with the f-number that gives that blur."""
        lens, metadata = self.stated_lens_of(index), self.slices[index].metadata
        if GROWTH not in metadata:
            return lens
        found = metadata[GROWTH] / lens.coc_px_per_dioptre(metadata[GROWTH_WIDTH])
        return replace(lens, f_number=lens.f_number / found)

    def registered_lens_of(self, index: int) -> Lens:
        """Return the lens of a registered slice: registration enlarged it to a larger picture of less of the sensor."""
        lens = self.lens_of(index)
        return replace(lens, sensor_width_mm=lens.sensor_width_mm / self.slices[index].scale)

    def coc_px_per_dioptre(self, index: int, width_px: int) -> float:
        """Return how fast blur grows in a registered slice, width_px wide: what registration enlarged grew with it."""
        return self.lens_of(index).coc_px_per_dioptre(width_px) * self.slices[index].scale

    def coc_px(self, index: int, depth_m: Float[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
        """Return the signed circle of confusion (diameter) of a registered slice."""
        return (self.lens_of(index).coc_px(depth_m, depth_m.shape[1]) * self.slices[index].scale).astype(np.float32)

    def depth_planes(self, *names: str) -> list[Float32[np.ndarray, "height width"]]:
        """Return channels of depth.exr (Z, focus_index, confidence, ...), the file read once."""
        self._require_merged()
        return [np.asarray(plane, np.float32) for plane in read_exr(self.depth_path)[0].planes(names)]

    def _depth_channel(self, name: str) -> Float32[np.ndarray, "height width"]:
        return self.depth_planes(name)[0]

    def _require_merged(self) -> None:
        if not self.merged:
            raise InputError(f"{self.folder} has no all-in-focus image and depth yet: run `mrbokeh capture merge` on it")


def write_merged(
    folder: Path,
    all_in_focus: Float32[np.ndarray, "height width 3"],
    focus_index: Float32[np.ndarray, "height width"],
    confidence: Float32[np.ndarray, "height width"],
    depth_m: Float32[np.ndarray, "height width"] | None,
    rec709_from_camera: Matrix3x3 | None = None,
) -> None:
    """Write the pictures of a merged stack: all_in_focus.exr and depth.exr (focus_index, confidence and, if metric, Z).

    all_in_focus: in the RGB that rec709_from_camera leads from, which is the stack's.
    """
    write_camera_rgb(folder / "all_in_focus.exr", all_in_focus, rec709_from_camera, half=False)
    channels = {"focus_index": focus_index, "confidence": confidence} | ({} if depth_m is None else {"Z": depth_m})
    write_exr(folder / "depth.exr", ExrPart(channels), compress=False)


def write_focal_stack(stack: FocalStack) -> None:
    """Write stack.json; the pictures must be in the folder already."""
    document = {
        "format": FORMAT,
        "version": VERSION,
        "reference": stack.reference,
        "registered": stack.registered,
        "merged": stack.merged,
        "rec709_from_camera": stack.rec709_from_camera,
        "lens": None if stack.lens is None else lens_to_json(stack.lens),
        "camera": None if stack.camera is None else camera_to_json(stack.camera),
        "slices": [vars(each) | {"focus_distance_m": _json_number(each.focus_distance_m)} for each in stack.slices],
        "metadata": stack.metadata,
    }
    write_json(stack.folder / FILE_NAME, document)


def read_focal_stack(folder: Path | str) -> FocalStack:
    """Read the stack in a folder; pictures are not opened. Raises InputError if the folder is not one."""
    folder = Path(folder)
    if not (folder / FILE_NAME).is_file():
        within = [str(each.parent) for each in sorted(folder.glob(f"*/{FILE_NAME}"))]
        others = f", or another of the {len(within)} in it" if len(within) > 1 else ", which lies in it"
        make = "make one of photographs by `mrbokeh capture process PHOTOGRAPHS --out SCENE`"
        require_file(folder / FILE_NAME, "a focal stack", f": give {within[0]}{others}" if within else f": {make}")
    document = read_json(folder / FILE_NAME, "a focal stack")
    if document.get("format") != FORMAT or document.get("version") != VERSION:
        raise InputError(
            f"{folder / FILE_NAME}: expected format {FORMAT!r} version {VERSION} (slices in camera RGB), got {document.get('format')!r} "
            f"version {document.get('version')!r}: run `mrbokeh capture ingest` on the photographs again, then `mrbokeh capture merge`"
        )
    try:
        return FocalStack(
            folder=folder,
            slices=tuple(Slice(**each | {"focus_distance_m": _number(each["focus_distance_m"])}) for each in document["slices"]),
            lens=None if document["lens"] is None else lens_from_json(document["lens"], str(folder)),
            camera=None if document["camera"] is None else camera_from_json(document["camera"]),
            reference=document["reference"],
            registered=document["registered"],
            merged=document["merged"],
            metadata=document["metadata"],
            rec709_from_camera=None if document["rec709_from_camera"] is None else matrix3x3(document["rec709_from_camera"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder / FILE_NAME} is incomplete ({error!r}): ingest the photographs again") from None


def _json_number(value: float | None) -> float | str | None:
    """Return infinity, which JSON lacks, as the word."""
    return "inf" if value == float("inf") else value


def _number(value: float | str | None) -> float | None:
    return None if value is None else float(value)


def require_folder(scene: Path) -> None:
    """Raise InputError unless there is a folder, in which focal stacks may be."""
    if not Path(scene).is_dir():
        raise InputError(
            f"expected a folder with focal stacks, but there is no folder {scene}: check the name, or run `mrbokeh capture process` first"
        )


def find_focal_stacks(scene: Path) -> list[FocalStack]:
    """Find the stacks of a scene: the folder itself, or the folders under it, by name."""
    require_folder(scene)
    folders = sorted(path.parent for path in Path(scene).rglob(FILE_NAME))
    if not folders:
        raise InputError(f"expected a focal stack (a folder with {FILE_NAME}) in {scene}, found none: run `mrbokeh capture process` first")
    return [read_focal_stack(folder) for folder in folders]
