"""The twin of a stack whose metres are known: the same pictures and the same blur in pixels, in metres that are guessed.

As merging leaves a stack of which no focus distance is stated: the nearest focus at 1 m and the farthest at 2 m.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.optics.camera import Camera
from mrbokeh.stacks.focal_stack import FocalStack, write_focal_stack
from mrbokeh.stacks.guessed_metres import POSITION, POSITION_ERROR

NEAREST_M, FARTHEST_M = 1.0, 2.0


def guessed_twin(stack: FocalStack, folder: Path, lens_stated: bool = False) -> FocalStack:
    """lens_stated: the growth of blur is right, and only how far all lies is a guess: 0.5 dioptres less than in truth."""
    shutil.copytree(stack.folder, folder)
    dioptres = np.array([1.0 / float(each or 0.0) for each in stack.focus_distances_m])
    stretch = 1.0 if lens_stated else (1.0 / NEAREST_M - 1.0 / FARTHEST_M) / float(np.ptp(dioptres))
    offset = -0.5 if lens_stated else 1.0 / FARTHEST_M - stretch * float(dioptres.min())

    def guess(true_m: np.ndarray | float) -> np.ndarray:
        return 1.0 / (offset + stretch / np.asarray(true_m))

    part = read_exr(stack.depth_path)[0]
    height, width = part.channels["Z"].shape
    growth = [stack.lens_of(index).coc_px_per_dioptre(width) / stretch for index in range(len(stack))]
    slices = tuple(
        replace(
            each,
            focus_distance_m=float(guess(float(each.focus_distance_m or 0.0))),
            metadata={"px_per_dioptre": px, "px_per_dioptre_width_px": width, "stated_focus_distance_m": None},
        )
        for each, px in zip(stack.slices, growth, strict=True)
    )
    assert stack.lens is not None
    focal_px = stack.lens_of(stack.reference).focal_px(width)
    camera = Camera(width, height, (focal_px, focal_px), (width / 2, height / 2))
    lens = stack.lens if lens_stated else replace(stack.lens, focal_length_mm=30.0, f_number=1.4)
    middle = float(np.mean(growth))
    gauge = {
        "px_per_dioptre": middle,
        "offset_dioptres": 1.0 / FARTHEST_M,
        "scale_from": "lens" if lens_stated else "guess",
        "offset_from": "guess",
    }
    facts = {"known": False, "why": "no focus distance is stated", "gauge": gauge}
    z_m = guess(part.channels["Z"]).astype(np.float32)
    position_px = ((1.0 / z_m - 1.0 / FARTHEST_M) * middle).astype(np.float32)
    channels = dict(part.channels) | {"Z": z_m, POSITION: position_px, POSITION_ERROR: np.full_like(position_px, 0.1)}
    twin = FocalStack(
        folder,
        slices,
        lens.focused_at(float(slices[stack.reference].focus_distance_m or 0.0)),
        camera,
        stack.reference,
        registered=True,
        merged=True,
        metadata={"metres": facts, "stated_before_guessing": {"lens": None, "camera": None}},
    )
    write_exr(twin.depth_path, replace(part, channels=channels))
    write_focal_stack(twin)
    return twin
