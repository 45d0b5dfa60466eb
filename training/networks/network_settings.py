"""Settings of a network's shape: every choice of Neural Bokeh, of our improvements and of the networks it is compared with."""

from dataclasses import dataclass
from typing import Literal

from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class NetworkSettings:
    """The shape of the network. The defaults are Neural Bokeh as published (Mandl et al. 2024, Section 3).

    form: "published" stacks residual blocks one after the other; "gated" is our variant in which every kernel size
        serves the pixels whose circle of confusion it fits (training/networks/gated_network.py); "deepfocus" and "neural_camera" are the
        networks that the paper compares itself with (training/networks/baseline_networks.py).
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
    lens_inputs: f-number and focal length are inputs, so that one network serves a lens at all its settings (training/networks/network.py).
    field_bases: gated form: kernels per bin, between which place and lens choose; 1 is the same kernel everywhere.
    headroom: the top of the network's range over the largest radiance of the data; black stays its bottom. tanh never reaches its ends,
        so with 1, as published, a highlight at the very top is cut: by 12 % when an identity starts to learn, by 0.3 to 3 % after 800
        steps of one block on made lights. With 1.5 it is not cut, but what is darker than white gets 1.5 times the error, because
        all of it moves nearer to the lower end, where tanh is flat too. So the presets keep 1; lights beyond the data's are no
        matter of the range (OnnxNetwork splits them off), and "identity" has no such ends.
    padding: what lies beyond the border for the published form; the gated form renormalises what is inside.
    initialisation: published form: "default" (PyTorch's), "identity" (the network starts by copying the picture) or "disc"
        (the first convolution of each block a disc of its size, the second adding a little of it);
        gated form: kernels start as "disc" or, by "default", as flat squares.
    hidden: gated form: features of the pointwise networks that decide who hides whom, and which base serves where;
        baselines: features of their convolutions.
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
    lens_inputs: bool = False
    field_bases: int = 1
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
        if not self.headroom >= 1.0:
            raise InputError(f"headroom is a factor of at least 1 on the largest radiance of the data, got {self.headroom}")
        self._require_a_form_that_can()

    def _require_a_form_that_can(self) -> None:
        if self.form in ("deepfocus", "neural_camera") and self.tile_px:
            raise InputError(f"the form {self.form} has no tiles, got tile_px {self.tile_px}: set tile_px to 0")
        if self.form != "published" and self.kernels == "3x3":
            raise InputError(f"3x3 kernels are a variant of the published form, got the form {self.form}: set kernels to growing")
        if self.field_bases < 1 or (self.field_bases > 1 and self.form != "gated"):
            raise InputError(
                f"only the gated form chooses between field_bases, got {self.field_bases} with the form {self.form}: set it to 1"
            )
        if self.form == "gated" and (self.field_bases > 1) != (self.input_channels > 4):
            raise InputError(
                f"the gated form uses place and lens to choose between field_bases, got field_bases {self.field_bases} with "
                f"field_position {self.field_position} and lens_inputs {self.lens_inputs}: set one of these two and field_bases above 1 "
                f"(4 is a good number), or neither"
            )

    @property
    def input_channels(self) -> int:
        """Return the number of inputs: R, G, B and circle of confusion; two for the place and two for the lens if they are inputs."""
        return 4 + 2 * self.field_position + 2 * self.lens_inputs
