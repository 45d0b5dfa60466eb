"""The first-pass pictures of a scene's stacks, as a plane sweep wants them."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float32

from capture.merging.second_pass import first_pass_path
from capture.poses.sweep_view import structure_of
from mrbokeh.images.camera_rgb import read_camera_rgb
from mrbokeh.stacks.focal_stack import FocalStack

_HELD = 8


class FirstPictures:
    """stacks: by the name of their view. A few structures are held."""

    def __init__(self, stacks: dict[str, FocalStack]) -> None:
        self.stacks = stacks
        self.view = lru_cache(_HELD)(self._view)

    def rgb(self, name: str) -> Float32[np.ndarray, "height width 3"]:
        """Linear Rec.709."""
        stack = self.stacks[name]
        return stack.to_rec709(read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path)))

    def _view(self, view_name: str) -> Float32[np.ndarray, "height width"]:
        return structure_of(self.rgb(view_name))
