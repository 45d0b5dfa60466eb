"""OpenedPhotograph: a photograph read once, made smaller for previews, with the lens of any state and the camera that its lines tell."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.commands._composite_layers import held_upright
from mrbokeh.commands._composite_options import CompositeOptions, typed_sun
from mrbokeh.commands._insertion_options import focused_at_pixel, require_one_focus
from mrbokeh.commands._level_ground import HIGH_SHARE, held_as_told, on_level_ground, sun_by_shadow, usual_tilt_rad, with_camera_of_file
from mrbokeh.compositing.open_plate import (
    HeldLens,
    LensWishes,
    held_lens,
    open_plate,
    phone_photo,
    photograph_plate,
    slice_lens,
    with_depth,
)
from mrbokeh.compositing.plate import Plate, read_matte, shrunk, shrunk_matte
from mrbokeh.compositing.plate_look.finishing import Finishing
from mrbokeh.depth.depth_map import DepthSettings
from mrbokeh.depth.phone_depth import PhonePhoto
from mrbokeh.optics.camera import camera_of_lens
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import lens_and_renderer
from mrbokeh.scene.staging.scene_description import looking_down
from mrbokeh.scene.staging.staged_scene import modified_s
from mrbokeh.solving.solve_camera import Line, solve_camera
from mrbokeh.solving.solved_camera import KNOWN, SolvedCamera
from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, read_focal_stack
from mrbokeh.stacks.photograph import Photograph, read_photograph
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import apart
from viewfinder.studio.command_line import options_of, preview_scale
from viewfinder.studio.state import DrawnLine, Pair, StudioState

MOST_PX = 1e6
"""Pixels of the largest preview."""
_LEAST_TILT_DEG, _FEW_PX = 1.0, 1e4


@dataclass
class OpenedPhotograph:
    """Photograph in memory, at most MOST_PX of it.

    path: of its file, or of the focal stack of which it is a slice. depth: file of its depth, in place of its own. told: what its file
    states, with the size of the whole but none of its light.
    finishings: what was measured of black and grain, by the options and the size.
    """

    path: Path
    depth: Path | None
    told: Photograph
    phone: PhonePhoto | None
    plate: Plate
    stack: FocalStack | None = None
    slice: int | None = None
    finishings: dict[object, Finishing] = field(default_factory=dict)
    _smaller: dict[tuple[int, int], Plate] = field(default_factory=dict)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the whole photograph."""
        return self.told.rgb.shape[1], self.told.rgb.shape[0]

    @property
    def has_depth(self) -> bool:
        return self.plate.depth_m is not None

    def scale(self, most_px: float) -> float:
        """Return the scale of a preview of at most so many pixels."""
        return preview_scale(*self.size_px, min(most_px, MOST_PX))

    def small(self, options: CompositeOptions, most_px: float) -> CompositeOptions:
        """Return the options for the photograph with at most so many pixels."""
        return options.scaled(self.size_px, self._small_px(most_px))

    def plate_for(self, options: CompositeOptions, most_px: float) -> tuple[Plate, Renderer]:
        """Return the plate that `mrbokeh composite` opens by these options, made smaller, and the renderer of its blur."""
        require_one_focus(focus=options.optics.focus, focus_at=options.optics.focus_at)
        lens, renderer = _lens_of(options.optics.lens, modified_s(options.optics.lens) if options.optics.lens else 0.0)
        lens = lens and options.facts.on(lens, renderer)
        stated, guessing = {} if lens else options.facts.given, not options.standing.plain
        small, focus_at = self._at(most_px), options.optics.focus_at
        if (matte := options.taken.matte) is not None:
            small = replace(small, near_alpha=shrunk_matte(self.whole_matte(matte), small.rgb.shape[1::-1]))
        focus_m = options.optics.focus if focus_at is None else 1.0
        if self.stack is not None:
            return self._slice_plate(small, options, lens), renderer
        held = held_lens(self.path, self.told, self.phone, LensWishes(lens, focus_m, stated, guessing))
        plate = _with_lens(small, held)
        if focus_at is None:
            return plate, renderer
        focused = focused_at_pixel(plate.lens, plate.depth_m, self.small(options, most_px).optics.focus_at or "")
        return _with_lens(small, replace(held, lens=focused)), renderer

    def whole_matte(self, path: Path) -> Float32[np.ndarray, "height width"]:
        """Return a matte of the photograph. Raises InputError for one of another size."""
        matte = _matte_of(path, modified_s(path))
        if matte.shape[::-1] != self.size_px:
            raise InputError(
                f"the matte {path} is {matte.shape[1]}x{matte.shape[0]} px, but the photograph {self.size_px[0]}x{self.size_px[1]}"
            )
        return matte

    def _slice_plate(self, small: Plate, options: CompositeOptions, lens: Lens | None) -> Plate:
        """Return the plate of a slice with the lens that `mrbokeh composite` gives it."""
        if options.facts.given and lens is None:
            raise InputError("the focal stack states its lens itself: leave out focal length, f-number and sensor width, or choose one")
        assert self.stack is not None and self.slice is not None
        focused, blur_from = slice_lens(self.stack, self.slice, lens, options.optics.focus)
        return replace(small, lens=focused, blur_from=blur_from)

    def slice_in_focus(self, x_px: float, y_px: float) -> int:
        """Return the slice of the stack that is focused nearest to what a pixel of the whole shows."""
        assert self.stack is not None
        scale = self.plate.rgb.shape[1] / self.size_px[0]
        depth_m = self.plate.depth_at_m(scale * x_px, scale * y_px)
        focused_m = [self.stack.lens_of(each).focus_distance_m for each in range(len(self.stack))]
        return int(np.argmin([abs(1.0 / each - 1.0 / depth_m) for each in focused_m]))

    def upright(self, options: CompositeOptions, most_px: float) -> tuple[Plate, Renderer, float | None]:
        """Return `plate_for` with how the camera was held, which is never looked for in lines, and its height where a file tells it.

        Where neither options nor depth tell it, it is as cameras usually are for the object's place.
        """
        plate, renderer = self.plate_for(options, most_px)
        standing, known_height_m = options.standing, None
        if options.virtual.camera is not None:
            plate, known_height_m = with_camera_of_file(plate, options.virtual.camera)
        if plate.depth_m is not None or standing.plain:
            return held_upright(plate, self.small(options, most_px).standing), renderer, known_height_m
        if standing.pitch is None and plate.world_from_camera is None:
            foot_px = self.small(options, most_px).standing.first_px
            down_rad = usual_tilt_rad(plate, plate.camera.unproject(np.array(foot_px), np.array(1.0)))
            plate = replace(plate, world_from_camera=looking_down(down_rad if abs(down_rad) >= np.radians(_LEAST_TILT_DEG) else 0.0))
        plate = held_as_told(plate, standing)
        return plate, renderer, known_height_m

    def _small_px(self, most_px: float) -> tuple[int, int]:
        """Return width and height of the photograph with at most so many pixels."""
        width_px, height_px = (max(1, round(self.scale(most_px) * each)) for each in self.size_px)
        return width_px, height_px

    def _at(self, most_px: float) -> Plate:
        """Return the plate with at most so many pixels; of the sizes asked for the last few are kept."""
        width_px, height_px = self._small_px(most_px)
        if (height_px, width_px) == self.plate.rgb.shape[:2]:
            return self.plate
        if (width_px, height_px) not in self._smaller:
            for size_px in list(self._smaller)[:-3]:
                del self._smaller[size_px]
            self._smaller[width_px, height_px] = shrunk(self.plate, width_px, height_px)
        return self._smaller[width_px, height_px]


def open_photograph(
    path: Path, depth: Path | None = None, slice_index: int | None = None
) -> tuple[OpenedPhotograph, Float32[np.ndarray, "height width 3"]]:
    """Read a photograph, or a slice of a focal stack, its reference by default; return it, and the light of the whole.

    Raises InputError where it is none.
    """
    stack = read_focal_stack(path) if (path / FILE_NAME).is_file() else None
    slice_index = None if stack is None else stack.reference if slice_index is None else slice_index
    photograph = None if stack or path.is_dir() else read_photograph(path)
    phone = phone_photo(path) if photograph else None
    whole = whole_plate(path, photograph, phone, depth, slice_index)
    height_px, width_px = whole.rgb.shape[:2]
    scale = preview_scale(width_px, height_px, MOST_PX)
    small = whole if scale == 1.0 else shrunk(whole, round(scale * width_px), round(scale * height_px))
    dark = np.broadcast_to(np.float32(0.0), whole.rgb.shape)
    told = replace(photograph, rgb=dark) if photograph else Photograph(rgb=dark)
    opened = OpenedPhotograph(path=path, depth=depth, told=told, phone=phone, plate=small, stack=stack, slice=slice_index)
    return opened, whole.rgb


def whole_plate(
    path: Path, photograph: Photograph | None, phone: PhonePhoto | None, depth: Path | None, slice_index: int | None = None
) -> Plate:
    """Return the plate of a photograph in all its pixels, with its own depth or that of a file; its lens means nothing yet.

    photograph: None of a slice of a focal stack.
    """
    lens = LensWishes(lens=Lens.default())
    whole = open_plate(path, slice_index) if photograph is None else photograph_plate(path, photograph, phone, lens)
    return whole if depth is None else replace(with_depth(whole, depth, DepthSettings()), depth_note="")


def _with_lens(plate: Plate, held: HeldLens) -> Plate:
    camera = camera_of_lens(held.lens, plate.rgb.shape[1], plate.rgb.shape[0])
    known = {"blur_from": held.blur_from, "focus_known": held.focus_known, "view_known": held.view_known}
    return replace(plate, lens=held.lens, camera=camera, rough_focus_m=held.rough_focus_m, white_lux=held.white_lux, **known)  # type: ignore[arg-type]


@lru_cache(maxsize=8)
def _lens_of(path: Path | None, _changed_s: float) -> tuple[Lens | None, Renderer]:
    """Return lens and renderer of a lens file, read again when it changed."""
    return lens_and_renderer(path, None)


@lru_cache(maxsize=2)
def _matte_of(path: Path, _changed_s: float) -> Float32[np.ndarray, "height width"]:
    """Return a matte, read again when it changed."""
    return read_matte(path)


def solved(photograph: Photograph, lines: Sequence[DrawnLine] = ()) -> SolvedCamera:
    """Return the camera that a photograph's lines tell, with the focal length that it states; drawn ones decide. Raises InputError if
    they do not tell.
    """
    height_px, width_px = photograph.rgb.shape[:2]
    focal_px = None
    if photograph.focal_length_mm is not None and photograph.sensor_width_mm is not None:
        stated_px = photograph.focal_length_mm / photograph.sensor_width_mm * width_px
        focal_px = stated_px if 0.3 < stated_px / max(height_px, width_px) < 30.0 else None
    told = [Line((x1, y1, x2, y2), axis) for x1, y1, x2, y2, axis in lines]
    return solve_camera(photograph.rgb, focal_px, told).of_sensor(photograph.sensor_width_mm)


def solved_by_hand(opened: OpenedPhotograph, lines: Sequence[DrawnLine]) -> SolvedCamera:
    """Return the camera by lines that are drawn on a photograph, in its pixels. Raises InputError if they do not tell."""
    width_px, _height_px = opened.size_px
    scale = opened.plate.rgb.shape[1] / width_px
    small = [(*(scale * each for each in (x1, y1, x2, y2)), axis) for x1, y1, x2, y2, axis in lines]
    return solved(replace(opened.told, rgb=opened.plate.rgb), small).resized(*opened.size_px)


def measured_height_m(state: StudioState, opened: OpenedPhotograph) -> float:
    """Return the height of the camera above the ground by something of known height. Raises InputError if it does not tell."""
    assert state.measured is not None
    x1, y1, x2, y2, metres = state.measured
    with apart():
        plate, *_ = opened.upright(options_of(anywhere(replace(state, measured=None), opened)), _FEW_PX)
    width_px, height_px = opened.size_px
    assert plate.world_from_camera is not None
    camera = SolvedCamera(width_px, height_px, plate.lens.focal_px(width_px), KNOWN, camera_from_world=plate.world_from_camera.T)
    return float(f"{camera.with_height((x1, y1, x2, y2), metres).camera_height_m:.4g}")


def placed(state: StudioState, opened: OpenedPhotograph) -> StudioState:
    """Return a complete state with the tilt and metres that `mrbokeh composite` would guess, so that they stay while the object is moved.

    Raises InputError for a place that is no ground.
    """
    if opened.has_depth and (state.camera_height_m, state.measured) != (None, None):
        state = replace(state, camera_height_m=None, measured=None)
    is_told = state.camera is not None or state.pitch_deg is not None or opened.plate.world_from_camera is not None
    whole = state.height is not None and (opened.has_depth or (state.camera_height_m is not None and is_told))
    if not state.is_complete or state.plain or whole:
        return state
    options = options_of(state)
    plate, _renderer, known_height_m = opened.upright(options, MOST_PX)
    standing = opened.small(options, MOST_PX).standing
    high_px = HIGH_SHARE * plate.rgb.shape[0]
    if plate.depth_m is not None:
        if plate.metres_guessed:
            return replace(state, height=f"{HIGH_SHARE * opened.size_px[1]:.0f}px")
        depth_m = plate.point_under_pixel_m(*standing.pixels[len(state.before)])[2]
        return replace(state, height=f"{plate.length_m(high_px, depth_m):.3g}")
    if not is_told:
        state = replace(state, pitch_deg=round(looks_down_deg(plate), 2))
        standing = replace(standing, pitch=state.pitch_deg)
    plate, on_ground = on_level_ground(plate, standing, known_height_m)
    assert on_ground.at is not None and plate.world_from_camera is not None
    foot_m = np.array([float(each) for each in on_ground.at[len(state.before)].split(",")])
    eyes_m = float(plate.world_from_camera[1] @ foot_m)
    height = state.height or f"{plate.length_m(high_px, foot_m[2]):.3g}"
    return replace(state, camera_height_m=state.camera_height_m or float(f"{eyes_m:.4g}"), height=height)


def anywhere(state: StudioState, opened: OpenedPhotograph) -> StudioState:
    """Return a complete state, where something is missing still, by which lens and camera are found; without a matte."""
    middle_px = (0.5 * opened.size_px[0], 0.8 * opened.size_px[1])
    return replace(state, photo=opened.path, object=state.object or Path("object.glb"), at_px=state.at_px or middle_px, matte=None)


def sun_by_pixels(state: StudioState, opened: OpenedPhotograph, pixels: Sequence[Pair]) -> tuple[Pair, str]:
    """Return where the sun stands (degrees to the right of the view, and above the horizon), and that in words.

    pixels: of the whole photograph, as of --sun-by. Raises InputError for pixels that cannot be that.
    """
    scale = opened.plate.rgb.shape[1] / opened.size_px[0]
    with apart() as words:
        plate, *_ = opened.upright(options_of(anywhere(replace(state, plain=False), opened)), MOST_PX)
        right_deg, above_deg = typed_sun(sun_by_shadow(plate, *((scale * x_px, scale * y_px) for x_px, y_px in pixels)))
    side = "right" if right_deg >= 0.0 else "left"
    told = f"by the shadow the sun is {abs(right_deg):.0f} degrees to the {side} of the view and {above_deg:.0f} above the horizon"
    return (float(f"{right_deg:.4g}"), float(f"{above_deg:.4g}")), "; ".join([told, *words.warnings])


def looks_down_deg(plate: Plate) -> float:
    """Return how far the camera of an upright plate looks down."""
    assert plate.world_from_camera is not None
    return float(np.degrees(np.arcsin(np.clip(plate.world_from_camera[1, 2], -1.0, 1.0)))) + 0.0
