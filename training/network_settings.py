"""The shape of a network: every choice of Neural Bokeh, of our improvements and of what it is compared with."""

from dataclasses import dataclass
from typing import Literal

from mrbokeh.errors import InputError


@dataclass(frozen=True)
class NetworkSettings:
    """The shape of the network. The defaults are Neural Bokeh as published (Mandl et al. 2024, Section 3).

    form: "published" stacks residual blocks one after the other; "gated" is our variant in which every kernel size
        serves the pixels whose circle of confusion it fits (training/gated_network.py); "deepfocus" and "neural_camera" are the
        networks that the paper compares itself with (training/deepfocus_network.py, neural_camera_network.py).
    kernels: published form: "growing" as published, or "3x3" in as many blocks (Table 1, row 2).
    blocks: N; None takes the smallest N whose largest kernel, 2N+1 px, covers the largest circle of confusion of the data.
    width: published form: features per colour channel (the paper's three-channel tensor is 1);
        gated form: kernels per kernel size.
    mixing: published form: "none" convolves every feature by itself, "colour" lets the features of one colour mix in each
        convolution, "tile" adds a 1x1 convolution over all features of a tile after every block.
    activation: of the output; "tanh" as published, "identity" has no upper end.
    tile_px, overlap_px: t and t_o; neighbouring tiles start t - t_o px apart. tile_px 0 is one tile of any size.
    signed_coc: tell near from far (the paper's circle of confusion has no sign).
    field_position: where a pixel lies in the frame is an input, so that one set of weights serves the whole picture without tiles.
    field_bases: gated form: kernels per bin, between which place and lens choose; 1 is the same kernel everywhere.
    lens_inputs: f-number and focal length are inputs, so that one network serves a lens at all its settings.
    headroom: the top of the network's range over the largest radiance of the data; above 1, where tanh is still steep, bright lights
        keep their values.
    padding: what lies beyond the border for the published form; the gated form renormalises what is inside.
    initialisation: published form: "default" (PyTorch's), "identity" (the network starts by copying the picture) or "disc"
        (the first convolution of each block a disc of its size, the second adding a little of it);
        gated form: kernels start as "disc" or, by "default", as flat squares.
    hidden: gated form: features of the pointwise network that decides who hides whom.
    kernels_per_colour: gated form: each colour has its own kernels, as a lens with chromatic aberration needs; or all share one.
    """

    form: Literal["published", "gated", "deepfocus", "neural_camera"] = "published"
    kernels: Literal["growing", "3x3"] = "growing"
    blocks: int | None = None
    width: int = 1
    mixing: Literal["none", "colour", "tile"] = "none"
    activation: Literal["tanh", "identity"] = "tanh"
    tile_px: int = 200
    overlap_px: int = 60
    signed_coc: bool = False
    field_position: bool = False
    field_bases: int = 1
    lens_inputs: bool = False
    headroom: float = 1.0
    padding: Literal["replicate", "reflect", "zeros"] = "replicate"
    initialisation: Literal["default", "identity", "disc"] = "identity"
    hidden: int = 32
    kernels_per_colour: bool = True

    def __post_init__(self) -> None:
        if self.tile_px and not 0 <= self.overlap_px < self.tile_px:
            raise InputError(
                f"tiles need 0 <= overlap_px < tile_px, got an overlap of {self.overlap_px} px with tiles of {self.tile_px} px"
            )
        if self.width < 1 or self.hidden < 1 or (self.blocks is not None and self.blocks < 1):
            raise InputError(f"expected width, hidden and blocks of at least 1, got {self.width}, {self.hidden}, {self.blocks}")
