"""New slices of a focal stack, between and beyond the captured ones; and transfer, one lens's blur on an all-in-focus photograph.

Refocusing renders from the all-in-focus picture and depth. The difference to a captured slice that rendering leaves (its residual: the
true shape of the blur, errors of the all-in-focus picture) can be carried over to a new focus nearby. Transfer: Mandl et al. 2024,
Section 5.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap, DepthSettings
from mrbokeh.depth.open_depth import open_depth
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.image_io import write_image
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.stacks.focal_stack import FocalStack, Slice, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.stacks.focus_places import index_between, slice_names
from mrbokeh.stacks.guessed_metres import GUESSED
from mrbokeh.stacks.photograph import Photograph, read_photograph
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]

CAPTURED_DIOPTRES = 1e-6
RESIDUAL_REACH_PX = 24.0
"""A residual counts fully where the blur is that of its slice, and 1/e where the circle of confusion differs by this."""
RESIDUAL_LIGHT, RESIDUAL_LIGHT_REACH_PX = 0.95, 4.0
"""Share of white: what is brighter, in the slice or as rendered, is of lights, whose discs change with the focus: it reaches less far."""
RESIDUAL_WHITE, RESIDUAL_MEASURED = 0.98, 0.85
"""Shares of white: what a slice shows brighter than the first was not measured, so that it can only tell that rendering is too dark.
Down to the second that holds less and less: a border between what is believed and what is not would be seen as stairs."""
RESIDUAL_BLUR, RESIDUAL_LARGEST_BLUR_PX = 0.85, 2.0
"""Detail of a residual finer than this share of the difference in blur, 2 px at most, is not carried over: it is noise or another's."""

_CLIPPED_FROM, _CLIPPED_AT = 0.97, 0.995


def lens_at(stack: FocalStack, focus_m: float, lens: Lens | None = None) -> Lens:
    """Return the stack's lens at any focus, with the blur of its registered slices: f-number and scale interpolate in dioptres.

    lens: another one, which takes the focus and nothing else of the stack's.
    """
    if lens is not None:
        return lens.focused_at(focus_m)
    lenses = [stack.lens_of(index) for index in range(len(stack))]
    dioptres = np.array([1.0 / each.focus_distance_m for each in lenses])
    order = np.argsort(dioptres)

    def between(values: list[float]) -> float:
        return float(np.interp(1.0 / focus_m, dioptres[order], np.array(values)[order]))

    # What registration enlarged is a larger picture of a smaller piece of the sensor.
    sensor_mm = between([each.sensor_width_mm / one.scale for each, one in zip(lenses, stack.slices, strict=True)])
    focused = lenses[stack.reference].focused_at(focus_m)
    return replace(focused, f_number=between([each.f_number for each in lenses]), sensor_width_mm=sensor_mm)


class _Carry(NamedTuple):
    """Share of a slice's residual that is carried over; its circles of confusion differ from the new ones by coc_step_px everywhere."""

    weight: np.float32
    light_weight: np.float32
    coc_step_px: float

    @property
    def sigma_px(self) -> float:
        return min(RESIDUAL_BLUR * self.coc_step_px, RESIDUAL_LARGEST_BLUR_PX)


@dataclass(frozen=True)
class Refocusing:
    """Renderer of new slices of a merged stack with focus distances.

    residuals: whether to carry over the residuals of the slices next to the new focus. Without them captured slices are rendered like
    all others, so that nothing tells them apart in a focus pull.
    """

    stack: FocalStack
    renderer: Renderer
    lens: Lens | None = None
    residuals: bool = True

    def slice_at(self, focus_m: float, leave_out: int | None = None) -> Rgb:
        """Return (H, W, 3) linear Rec.709 as focused at focus_m (inf is allowed). With residuals a captured focus gives the captured
        slice.

        leave_out: a slice that is not used, to measure how well it is predicted. Raises InputError if focus distances are unknown.
        """
        captured = self._captured(leave_out)
        if not self.residuals or self.lens is not None:
            return self.rendered(focus_m)
        for index, distance_m in captured.items():
            if abs(1.0 / distance_m - 1.0 / focus_m) < CAPTURED_DIOPTRES:
                return self.stack.slice_rgb(index)
        rendered = self.rendered(focus_m)
        result, darkest, brightest = rendered.copy(), rendered.copy(), rendered.copy()
        for index, carry in self._carried(captured, focus_m).items():
            beside, plain, light = self._residuals_of(index)
            result += _smoothed(carry.weight * plain + carry.light_weight * light, carry.sigma_px)
            np.minimum(darkest, beside, out=darkest)
            np.maximum(brightest, beside, out=brightest)
        # Beyond what the slices beside it and rendering show, a residual is of something that blurs otherwise: black specks in a dark bag.
        return np.clip(result, darkest, brightest)

    def lens_at(self, focus_m: float) -> Lens:
        return lens_at(self.stack, focus_m, self.lens)

    def rendered(self, focus_m: float) -> Rgb:
        return self.renderer.render([self._sharp()], self.lens_at(focus_m)).rgb

    def _residuals_of(self, index: int) -> tuple[Rgb, Rgb, Rgb]:
        """Return (captured slice, its residual against its rendering, residual at highlights); each 0 elsewhere, and without data."""
        masks, captured = self.stack.slice_masks(index), self.stack.slice_rgb(index)
        rendered = self.rendered(float(self._captured(None)[index]))
        residual = np.where(masks.valid[..., None], captured - rendered, np.float32(0.0))
        white = np.float32(self.stack.slices[index].metadata.get("saturation_level") or 1.0)  # of a full grey; colours differ from it
        peak = captured.max(axis=2) / white
        light = (masks.saturated | (np.maximum(peak, rendered.max(axis=2) / white) >= RESIDUAL_LIGHT))[..., None]
        measured = np.clip((RESIDUAL_WHITE - peak[..., None]) / np.float32(RESIDUAL_WHITE - RESIDUAL_MEASURED), 0.0, 1.0)
        residual = np.where(residual < 0.0, residual * measured, residual)
        return captured, np.where(light, np.float32(0.0), residual), np.where(light, residual, np.float32(0.0))

    def _sharp(self) -> Layer:
        return opaque(self.stack.all_in_focus(), self.stack.depth_m())

    def _captured(self, leave_out: int | None) -> dict[int, float]:
        distances = {index: distance for index, distance in enumerate(self.stack.focus_distances_m) if distance is not None}
        if len(distances) < len(self.stack):
            raise InputError(f"{self.stack.folder} does not know its focus distances: add them to lens.toml and ingest again")
        return {index: distance for index, distance in distances.items() if index != leave_out}

    def _carried(self, captured: dict[int, float], focus_m: float) -> dict[int, "_Carry"]:
        """Return the slices on either side of the focus, evenly in dioptres, weighted less the more their blur differs from the new
        one.
        """
        wanted = 1.0 / focus_m
        nearer = [index for index in captured if 1.0 / captured[index] >= wanted]
        farther = [index for index in captured if 1.0 / captured[index] < wanted]
        sides = [min(side, key=lambda index: abs(1.0 / captured[index] - wanted)) for side in (nearer, farther) if side]
        steps = {index: abs(1.0 / captured[index] - wanted) for index in sides}
        per_dioptre = lens_at(self.stack, focus_m).coc_px_per_dioptre(self._width_px())
        total = sum(steps.values())
        share = {index: 1.0 - step / total if len(sides) == 2 and total > 0 else 1.0 for index, step in steps.items()}
        steps_px = {index: step * per_dioptre for index, step in steps.items()}

        def weight(index: int, reach_px: float) -> np.float32:
            return np.float32(share[index] * np.exp(-((steps_px[index] / reach_px) ** 2)))

        return {
            index: _Carry(weight(index, RESIDUAL_REACH_PX), weight(index, RESIDUAL_LIGHT_REACH_PX), step_px)
            for index, step_px in steps_px.items()
        }

    def _width_px(self) -> int:
        return self.stack.slice_camera_rgb(self.stack.reference).shape[1]


def _smoothed(residual: Rgb, sigma_px: float) -> Rgb:
    import cv2

    return cv2.GaussianBlur(residual, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT) if sigma_px > 0.1 else residual


@dataclass(frozen=True)
class SharpPhotograph:
    """Photograph all in focus with depth at its size.

    focus_m: focus of a phone, in the unit of its depth, or None. stack: the focal stack whose all-in-focus picture it is, or None.
    """

    photograph: Photograph
    depth: DepthMap
    focus_m: float | None = None
    stack: FocalStack | None = None

    @property
    def layer(self) -> Layer:
        return opaque(self.photograph.rgb, self.depth.depth_m)


def open_sharp(photo: Path, depth: Path | None, settings: DepthSettings) -> SharpPhotograph:
    """Open a photograph with its depth. Raises InputError if there is no depth.

    depth: None if the photograph itself holds it (a phone's). A phone's photograph with a blurred face gives the sharp original
    inside, a merged focal stack its all-in-focus picture and its depth.
    """
    if photo.is_dir():
        return _of_stack(read_focal_stack(photo), depth, settings)
    phone = read_phone_photo(photo, settings.near_far_m if depth is None else None)
    if phone is None and depth is None:
        raise InputError(f"{photo} holds no depth of its own: give --depth (EXR, PNG, stereo disparity, or a depth network .onnx)")
    photograph = read_photograph(photo)
    if phone is not None and phone.original_rgb is not None:
        photograph = replace(photograph, rgb=phone.original_rgb)
    focus_m = phone.focus.focus_distance_m if phone is not None and phone.focus is not None and depth is None else None
    if focus_m is not None and settings.near_far_m is not None:
        focus_m = None  # in the phone's own unit, which the user replaced
    return SharpPhotograph(photograph, open_depth(depth or photo, photograph.rgb, settings), focus_m)


def _of_stack(stack: FocalStack, depth: Path | None, settings: DepthSettings) -> SharpPhotograph:
    rgb = stack.all_in_focus()
    if depth is not None:
        return SharpPhotograph(Photograph(rgb), open_depth(depth, rgb, settings), stack=stack)
    unit = "metres" if stack.metres_known else GUESSED
    found = DepthMap(stack.depth_m(), stack.depth_valid(), f"of the stack {stack.folder}, {unit}")
    return SharpPhotograph(Photograph(rgb), found, stack=stack)


def write_made_stack(
    folder: Path,
    sharp: SharpPhotograph,
    lens: Lens,
    distances_m: Iterable[float],
    blurred: Callable[[float], Rgb],
    metadata: Mapping[str, Any],
    *,
    half: bool = False,
) -> None:
    """Write a focal stack of computed slices. blurred: the slice at a focus distance. metadata: of the stack. half: floats of slices."""
    taken: list[float] = []
    for number, distance_m in enumerate(distances_m):
        write_image(folder / f".{number}.exr", blurred(distance_m), half=half)
        taken.append(distance_m)
    slices = tuple(map(Slice, slice_names(tuple(taken)), taken))
    for number, each in enumerate(slices):
        (folder / f".{number}.exr").rename(folder / each.path)
    depth, index = sharp.depth, index_between(taken, sharp.depth.dioptres)
    write_merged(folder, sharp.photograph.rgb, index, depth.valid.astype(np.float32), depth.depth_m)
    made = FocalStack(folder, slices, lens.focused_at(taken[0]), registered=True, merged=True, metadata=dict(metadata))
    write_focal_stack(made)


def seen_like(lens: Lens, photograph: Photograph, photo: Path) -> Lens:
    """The lens with the photograph's field of view at its own f-number, on its own sensor: a longer or shorter sister of it."""
    if photograph.focal_length_mm is None or photograph.sensor_width_mm is None:
        raise InputError(
            f"{photo} does not tell its focal length and sensor: leave --same-view out, or give the lens the focal length wanted"
        )
    return replace(lens, focal_length_mm=lens.sensor_width_mm * photograph.focal_length_mm / photograph.sensor_width_mm)


def with_recovered_highlights(rgb: Rgb, stops: float) -> Rgb:
    """Brighten clipped white by so many stops. A guess, which the user makes and not the program.

    The change is smooth from codes of 0.97 to 0.995, so that the edge of a highlight does not become a line.
    """
    code = np.clip(linear_to_srgb(rgb.max(axis=2)), 0.0, 1.0)
    clipped = np.clip((code - _CLIPPED_FROM) / (_CLIPPED_AT - _CLIPPED_FROM), 0.0, 1.0)
    return (rgb * (1.0 + clipped * (2.0**stops - 1.0))[..., None]).astype(np.float32)
