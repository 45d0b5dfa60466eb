"""A tiny stack with a depth edge and lights: a card in front of a wall, photographed by the reference renderer."""

from pathlib import Path

import numpy as np

from mrbokeh.images.image_io import write_image
from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged

SIZE = (48, 72)
LENS = Lens(focal_length_mm=35.0, f_number=2.8, focus_distance_m=1.0, sensor_width_mm=3.5, aperture=Aperture.blades(6, 0.2))
CARD_M, WALL_M = 0.5, 0.7
FOCUS_M = (CARD_M, 0.55, WALL_M)
CARD_PX = 30


def make_card_stack(folder: Path, seed: int, focus_m: tuple[float, ...] = FOCUS_M) -> FocalStack:
    """The card is CARD_PX wide on the left; two lights of radiance 20 on the wall. Focused on the card, the wall is 14 px blurred."""
    rng = np.random.default_rng(seed)
    coarse = np.kron(rng.random((SIZE[0] // 4, SIZE[1] // 4, 3)), np.ones((4, 4, 1)))
    rgb = (0.6 * coarse + 0.2 * rng.random((*SIZE, 3))).astype(np.float32)
    rgb[rng.integers(10, 38, 2), rng.integers(45, 60, 2)] = 20.0
    depth_m = np.full(SIZE, WALL_M, np.float32)
    depth_m[:, :CARD_PX] = CARD_M
    slices = tuple(Slice(f"slice_{index}.exr", distance) for index, distance in enumerate(focus_m))
    stack = FocalStack(folder, slices, LENS, registered=True, merged=True)
    folder.mkdir(parents=True)
    write_merged(folder, rgb, np.zeros(SIZE, np.float32), np.ones(SIZE, np.float32), depth_m)
    for index in range(len(focus_m)):
        blurred = ScatterReference(threads=1).render([opaque(rgb, depth_m)], stack.lens_of(index))
        write_image(folder / slices[index].path, blurred.rgb, half=False)
    write_focal_stack(stack)
    return stack


def make_card_scene(folder: Path) -> Path:
    """Two viewpoints."""
    for seed in range(2):
        make_card_stack(folder / f"view_{seed}", seed)
    return folder
