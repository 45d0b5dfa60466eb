"""Previews: a state as a picture by the functions of `mrbokeh composite`, in a thread that makes only the newest picture asked for."""

import logging
import time
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from threading import Condition, Thread
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from mrbokeh.commands._composite_files import blur_told
from mrbokeh.commands._composite_kept import KeptParts
from mrbokeh.commands._composite_layers import objects_of
from mrbokeh.commands._composite_options import CompositeOptions
from mrbokeh.commands._composited import composited, placed
from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.plate_look.finishing import Finishing, finishing_of, matched_finishing, white_balanced
from mrbokeh.images.color import srgb_codes
from mrbokeh.images.layer import Layer
from mrbokeh.scene.staging.staged_scene import StagedObject
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import apart
from viewfinder.studio.loupe import Region, WholePhotograph, photographed, region_of
from viewfinder.studio.photograph import MOST_PX, OpenedPhotograph

_log = logging.getLogger(__name__)

DRAFT_S = 0.12
"""Time that a draft should take; drafts get as many pixels as that allows."""
_FEWEST_PX, _MOST_DRAFT_PX, _FIRST_PX = 6e4, 5e5, 2e5
_DRAFT_QUALITY, _QUALITY = 80, 92
_MOST_FINISHINGS = 3


@dataclass(frozen=True)
class Preview:
    """Picture of a state. told: boxes of the objects in shares of the picture, its blur in words, what was guessed, warnings, and time."""

    rgb: Float32[np.ndarray, "height width 3"]
    told: dict[str, Any]


def preview_of(photograph: OpenedPhotograph, options: CompositeOptions, kept: KeptParts, most_px: float = MOST_PX) -> Preview:
    """Return the picture that `mrbokeh composite` makes by these options, of the photograph made smaller. Raises InputError.

    Where the photograph has no more than most_px, and kept makes no draft, it is the very same picture.
    """
    with apart() as words:
        plate, renderer, known_height_m = photograph.upright(options, most_px)
        small = photograph.small(options, most_px)
        small.standing.require_meant(photograph.path, small.taken.depth, small.rendering.catch)
        plate, small = placed(plate, small, known_height_m)
        if kept.draft and plate.depth_m is not None:
            small = replace(small, virtual=replace(small.virtual, mode="over"))
        finishing = white_balanced(small.look.wanted) if kept.draft else finishing_by(photograph, plate, small)
        made = composited(plate, small, renderer, finishing, kept=kept, asked=options.standing)
        plate, sharp = made.plate, made.sharp
        blur, _known, figures = blur_told(plate, sharp)
        told = {
            "boxes": [_box(sharp[0])] if len(small.standing.each) == 1 else _boxes(small, plate, kept),
            "blur": blur,
            "focus_m": plate.lens.focus_distance_m if np.isfinite(plate.lens.focus_distance_m) else None,
            "f_number": plate.lens.f_number,
            "coc_px": [float(each) / photograph.scale(most_px) for each in figures.get("coc_px", ())],
            "guessed": list(words.guessed),
            "warnings": list(dict.fromkeys(words.warnings)),
        }
    return Preview(made.inserted.rgb, told)


def finishing_by(photograph: OpenedPhotograph, plate: Plate, options: CompositeOptions) -> Finishing:
    """Return what makes the object look photographed, measured once for each size of the photograph.

    A photograph made smaller shows no trace of its compression.
    """
    wanted, path = options.look.wanted, photograph.path
    key = (options.look, options.standing.plain, plate.rgb.shape)
    if key not in photograph.finishings:
        if len(photograph.finishings) > _MOST_FINISHINGS:
            photograph.finishings.clear()
        if options.standing.plain or photograph.stack:
            photograph.finishings[key] = finishing_of(wanted, plate.rgb, None if photograph.stack else path)
        else:
            is_smaller = plate.rgb.shape[1::-1] != photograph.size_px
            photograph.finishings[key] = matched_finishing(wanted, plate.rgb, path, uncompressed=is_smaller)[0]
    return photograph.finishings[key]


def _box(layer: Layer) -> list[float] | None:
    """Return left, top, right and bottom of what a layer shows, in shares of the picture; None if it shows nothing."""
    rows, columns = np.nonzero(layer.alpha > 0.5)
    if not len(rows):
        return None
    height, width = layer.alpha.shape
    sides = (columns.min() / width, rows.min() / height, (columns.max() + 1) / width, (rows.max() + 1) / height)
    return [float(each) for each in sides]


def _boxes(options: CompositeOptions, plate: Plate, kept: KeptParts) -> list[list[float] | None]:
    """Return such a box for each object, by the corners of its surface, whether something hides it or not."""
    size_px, boxes = np.array([plate.camera.width_px, plate.camera.height_px]), []
    for one in objects_of(options.standing, plate):
        staged = StagedObject(one.described().objects[0], kept.assets.glb(one.glb), "-y").scene_at(options.rendering.time)
        xy_px, depth_m = one.seen_by(plate.camera).project(np.concatenate([mesh.positions_m for mesh in staged.drawn_meshes]))
        shares = xy_px[depth_m > 0.0] / size_px
        low, high = (np.clip(bound, 0.0, 1.0).tolist() for bound in (shares.min(0), shares.max(0))) if len(shares) else ([0, 0], [0, 0])
        boxes.append([*low, *high] if low[0] < high[0] and low[1] < high[1] else None)
    return boxes


def jpeg_of(rgb: Float32[np.ndarray, "height width 3"], quality: int = _QUALITY) -> bytes:
    """Return linear light as a JPEG, as `mrbokeh composite` encodes it for a screen."""
    codes = srgb_codes(rgb, np.uint8)
    return cv2.imencode(".jpg", np.ascontiguousarray(codes[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


@dataclass
class Wish:
    """Picture that a page waits for, or a region of it. options: None shows a region of the photograph as it is.

    answer: (what is told, JPEG), or None where a newer wish of the page took its place.
    """

    photograph: OpenedPhotograph
    options: CompositeOptions | None
    most_px: float
    draft: bool
    region: Region | None = None
    answer: "Future[tuple[dict[str, Any], bytes] | None]" = field(default_factory=Future)


class Previewer:
    """A thread that answers wishes, of each page only the newest; pages take turns. name: of the thread."""

    def __init__(self, name: str = "studio previews") -> None:
        self._waiting: dict[str, Wish] = {}
        self._changed = Condition()
        self._ended = False
        self._kept: tuple[OpenedPhotograph, KeptParts] | None = None
        self._whole: WholePhotograph | None = None
        self._draft_px, self._slow = _FIRST_PX, 0
        self._thread = Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def ask(self, page: str, wish: Wish) -> "Future[tuple[dict[str, Any], bytes] | None]":
        """Put a wish in the place of the page's last one, unless that is being made already."""
        with self._changed:
            dropped = self._waiting.pop(page, None)
            self._waiting[page] = wish
            self._changed.notify()
        if dropped is not None and dropped.answer.set_running_or_notify_cancel():
            dropped.answer.set_result(None)
        return wish.answer

    def close(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(3.0)

    def _work(self) -> None:
        while (wish := self._next()) is not None:
            # A page that went away has given its wish up.
            if wish.answer.set_running_or_notify_cancel():
                self._answer(wish)

    def _answer(self, wish: Wish) -> None:
        try:
            wish.answer.set_result(self._made(wish))
        except InputError as error:
            wish.answer.set_exception(error)
        except Exception as error:
            _log.exception("a preview failed")
            wish.answer.set_exception(InputError(f"this is a fault of mrbokeh ({type(error).__name__}); the terminal says more"))

    def _next(self) -> Wish | None:
        with self._changed:
            while not self._waiting and not self._ended:
                self._changed.wait()
            return None if self._ended else self._waiting.pop(next(iter(self._waiting)))

    def _made(self, wish: Wish) -> tuple[dict[str, Any], bytes]:
        if self._kept is None or self._kept[0] is not wish.photograph:
            self._kept = wish.photograph, KeptParts()
        kept, began_s = self._kept[1], time.perf_counter()
        if wish.region is not None:
            return self._region(wish, wish.region, kept)
        assert wish.options is not None, "only a region may be of the photograph alone"
        kept.holds_light = False
        kept.draft, kept.small = wish.draft, wish.photograph.scale(wish.most_px) < 1.0
        most_px = min(wish.most_px, self._draft_px) if wish.draft else wish.most_px
        preview = preview_of(wish.photograph, wish.options, kept, most_px)
        jpeg = jpeg_of(preview.rgb, _DRAFT_QUALITY if wish.draft else _QUALITY)
        took_s = time.perf_counter() - began_s
        if wish.draft:
            self._adapt(took_s)
        size_px = [preview.rgb.shape[1], preview.rgb.shape[0]]
        return preview.told | {"ms": round(1e3 * took_s), "size_px": size_px, "draft": wish.draft}, jpeg

    def _region(self, wish: Wish, region: Region, kept: KeptParts) -> tuple[dict[str, Any], bytes]:
        if self._whole is None or self._whole.photograph is not wish.photograph:
            self._whole = WholePhotograph(wish.photograph)
        if wish.options is None:
            return {"region": True}, jpeg_of(photographed(self._whole, region))
        kept.draft, kept.small, kept.holds_light = False, True, True
        return {"region": True}, jpeg_of(region_of(self._whole, wish.options, kept, region))

    def _adapt(self, took_s: float) -> None:
        """Choose the next draft's size by what the last one took, in steps, as a new size has to be prepared."""
        if took_s > 1.5 * DRAFT_S:
            self._slow += 1
        self._slow = 0 if took_s < 1.2 * DRAFT_S else self._slow
        step = 0.5 if self._slow > 1 else 2.0 if took_s < 0.4 * DRAFT_S else 1.0
        if step != 1.0:
            self._draft_px, self._slow = float(np.clip(step * self._draft_px, _FEWEST_PX, _MOST_DRAFT_PX)), 0
