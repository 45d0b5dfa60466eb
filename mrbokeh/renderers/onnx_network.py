"""A trained network (.onnx) as a Renderer, and the facts that its file states about itself (JSON in its metadata).

The graph takes `rgb` (B, 3, H, W) linear radiance and `coc_px` (B, 1, H, W) signed diameters and gives `blurred` (B, 3, H, W);
tiles, the sign of the circle of confusion and the range of the network are handled in the graph. If its facts say so it also
takes `place` (B, 2, H, W), field positions in the whole frame, and `lens` (B, 2), f-number and focal length in mm.
Widths: a circle of confusion means the same number of pixels whatever the picture's width, so a network without tiles takes
any width at which the blur stays within its training range. Tiles belong to one size of picture.
Highlights above the radiance scale: a network that is linear in radiance takes them as they are. For any other the part above
the scale goes through the network as an exposure of its own, darkened into range and brightened again, and is added.
A layer's depth is continued beyond its silhouette, and only the window that it can reach goes through the network.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.optics.camera import field_positions
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_from_json, lens_to_json
from mrbokeh.renderers.onnx_sessions import open_session, provider_of
from mrbokeh.system.errors import InputError

FORMAT = "mrbokeh-neural-bokeh"
VERSION = 1
METADATA_KEY = "mrbokeh"


@dataclass(frozen=True)
class NetworkFacts:
    """Facts of an exported network: its lens, and the range that it was trained for.

    lens: its focus may change, and f-number and focal length if they are inputs, but nothing else.
    width_px, height_px: the pictures it was trained on; the only size when tiled.
    largest_coc_px: the largest diameter it was trained for. radiance_scale: the largest radiance it was trained for.
    reach_px: how far from a pixel the network looks. commit: of the training code, or None.
    trained_on: names of the stacks. held_out_slices: slices of the only stack that were not trained on.
    field_position: the place in the frame is an input. f_numbers, focal_lengths_mm: (lowest, highest) trained on if the lens is an
    input, else None. These, held_out_slices and lens_guessed are missing in older files.
    lens_guessed: it was trained on blur in pixels, at distances in unknown units: the lens stands for no length.
    """

    lens: Lens
    width_px: int
    height_px: int
    largest_coc_px: float
    radiance_scale: float
    signed_coc: bool
    tiled: bool
    linear_in_radiance: bool
    reach_px: int
    trained_on: tuple[str, ...] = ()
    commit: str | None = None
    field_position: bool = False
    f_numbers: tuple[float, float] | None = None
    focal_lengths_mm: tuple[float, float] | None = None
    held_out_slices: tuple[int, ...] = ()
    lens_guessed: bool = False

    @property
    def lens_inputs(self) -> bool:
        """Whether f-number and focal length are inputs."""
        return self.f_numbers is not None and self.focal_lengths_mm is not None

    def to_json(self) -> str:
        return json.dumps({"format": FORMAT, "version": VERSION, **vars(self), "lens": lens_to_json(self.lens)})


def facts_from_json(text: str, where: str) -> NetworkFacts:
    """Read facts; InputError if the text is of another format or version."""
    document: dict[str, Any] = json.loads(text)
    if document.pop("format", None) != FORMAT or document.pop("version", None) != VERSION:
        raise InputError(f"{where}: expected a network of format {FORMAT!r} version {VERSION}: export it again with `mrbokeh train export`")
    lens = lens_from_json(document.pop("lens"), where)
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in document.items()}
    return NetworkFacts(lens=lens, **values)


def depth_around(
    depth_m: Float32[np.ndarray, "height width"], covered: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """Return depth in which every uncovered pixel has that of the nearest covered one, so that blur can spread beyond the silhouette."""
    from scipy.ndimage import distance_transform_edt

    if covered.all():
        return depth_m
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return depth_m[tuple(nearest)]


def grown(covered: Bool[np.ndarray, "height width"], radius_px: int) -> Bool[np.ndarray, "height width"]:
    """Return a mask of all pixels within radius_px of a covered one."""
    from scipy.ndimage import distance_transform_edt

    return covered if covered.all() else distance_transform_edt(~covered) <= radius_px + 0.5


def window_around(reached: Bool[np.ndarray, "height width"], margin_px: int) -> tuple[slice, slice]:
    """Return the rectangle around all pixels reached, with the margin that the network must see."""
    rows, columns = np.flatnonzero(reached.any(axis=1)), np.flatnonzero(reached.any(axis=0))
    return tuple(slice(max(0, int(each[0]) - margin_px), int(each[-1]) + 1 + margin_px) for each in (rows, columns))  # type: ignore[return-value]


__all__ = ["FORMAT", "METADATA_KEY", "NetworkFacts", "OnnxNetwork"]

_SAME_LENS = 0.05
"""Share by which a lens may differ: registered slices of a lens that breathes state a sensor up to 3 % narrower, and f-numbers alike."""
_COC_SLACK = 1.02
_SENSOR_BLUR_PX = 1  # a photograph is never sharper than its sensor, so light learned from it reaches a little beyond its disc


class OnnxNetwork:
    """Renderer that blurs as the lens it learned from; it refuses lenses, sizes and blur that it was not trained for.

    threads: of ONNX Runtime, 0 takes all cores. providers: see `open_session`; `provider` says which one runs.
    """

    def __init__(self, path: Path, threads: int = 0, providers: Sequence[str] | None = None) -> None:
        self._session = open_session(path, threads, providers)
        self.provider = provider_of(self._session)
        stored = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        if stored is None:
            raise InputError(f"{path} does not say which lens it was trained for: export it with `mrbokeh train export`")
        self.facts = facts_from_json(stored, str(path))

    @property
    def lens(self) -> Lens:
        """The lens it was trained for, with the focus of its first training slice."""
        return self.facts.lens

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        """Render layers (see Renderer) by the trained lens: the aperture of `lens` has no effect, and extra channels are left out."""
        self._require_trained_lens(lens)
        return flatten([self._blurred_layer(layer, lens) for layer in layers])

    def blur(
        self,
        rgb: Float32[np.ndarray, "height width 3"],
        coc_px: Float32[np.ndarray, "height width"],
        place: Float32[np.ndarray, "height width 2"] | None = None,
        lens: tuple[float, float] | Float32[np.ndarray, "2"] | None = None,
    ) -> Float32[np.ndarray, "height width 3"]:
        """Blur an opaque picture by a signed circle of confusion (diameter) per pixel; linear radiance of any height.

        place: field positions (see optics.field_position); None: the picture is a whole frame. lens: (f-number, focal length in mm);
        None: those of `self.lens`. Both are left out where the network does not use them.
        """
        self._require_trained_size(*coc_px.shape)
        feed = {"coc_px": np.ascontiguousarray(coc_px)[None, None], **self._further_inputs(coc_px.shape, place, lens)}
        scale = np.float32(self.facts.radiance_scale)
        excess = np.maximum(rgb - scale, 0.0)
        if self.facts.linear_in_radiance or not excess.any():
            return self._run(rgb, feed)
        brightest = excess.max()
        black = self._run(np.zeros_like(rgb), feed)
        highlights = self._run(excess * (scale / brightest), feed) - black
        return self._run(np.minimum(rgb, scale), feed) + highlights * (brightest / scale)

    def _further_inputs(
        self, size_px: tuple[int, ...], place: np.ndarray | None, lens: tuple[float, float] | np.ndarray | None
    ) -> dict[str, np.ndarray]:
        """Return place and lens as the graph takes them, if it does."""
        inputs: dict[str, np.ndarray] = {}
        if self.facts.field_position:
            place = field_positions((size_px[0], size_px[1])) if place is None else place
            inputs["place"] = np.ascontiguousarray(place.transpose(2, 0, 1))[None]
        if self.facts.lens_inputs:
            f_number, focal_length_mm = (
                (self.lens.f_number, self.lens.focal_length_mm) if lens is None else (float(lens[0]), float(lens[1]))
            )
            self._require_trained("f_number", f_number)
            self._require_trained("focal_length_mm", focal_length_mm)
            inputs["lens"] = np.array([[f_number, focal_length_mm]], np.float32)
        return inputs

    def _run(self, rgb: np.ndarray, feed: dict[str, np.ndarray]) -> np.ndarray:
        picture = {"rgb": np.ascontiguousarray(rgb.transpose(2, 0, 1))[None]}
        return np.ascontiguousarray(self._session.run(["blurred"], picture | feed)[0][0].transpose(1, 2, 0))

    def _blurred_layer(self, layer: Layer, lens: Lens) -> Layer:
        """Blur colour and coverage by the same network, cropped to where the layer can reach; outside that it stays empty."""
        covered = layer.alpha > 0
        if not covered.any():
            return clear(layer.height_px, layer.width_px)
        coc_px = lens.coc_px(depth_around(layer.depth_m, covered), layer.width_px).astype(np.float32)
        largest_px = float(np.abs(coc_px).max())
        self._require_trained_coc(largest_px, layer.width_px)
        reached = grown(covered, int(np.ceil(largest_px / 2.0)) + _SENSOR_BLUR_PX)
        window = np.s_[:, :] if self.facts.tiled else window_around(reached, self.facts.reach_px)
        place = field_positions(coc_px.shape)[window] if self.facts.field_position else None
        seen = (coc_px[window], place, (lens.f_number, lens.focal_length_mm))
        rgb, alpha = np.zeros_like(layer.rgb), np.zeros_like(layer.alpha)
        rgb[window] = self.blur(layer.rgb[window], *seen)
        whole = bool((layer.alpha[window] == 1).all())
        # Coverage is seen as white light of radiance 1, so that it spreads as the colours do.
        alpha[window] = 1.0 if whole else self.blur(_white(layer.alpha[window]), *seen).mean(axis=2).clip(0.0, 1.0)
        return Layer(np.maximum(rgb, 0) * reached[..., None], alpha * reached, layer.depth_m)

    def _require_trained_lens(self, lens: Lens) -> None:
        for name in ("focal_length_mm", "f_number"):
            self._require_trained(name, getattr(lens, name))
        # Held upright, the width of the sensor lies along the height of the picture.
        upright = (lens.sensor_height_mm or 0.0) > lens.sensor_width_mm
        self._require_trained("sensor_width_mm", lens.sensor_height_mm if upright and lens.sensor_height_mm else lens.sensor_width_mm)

    def _require_trained(self, name: str, got: float) -> None:
        """Refuse a value of the lens that is out of the trained range, or, if it is no input, not that of the trained lens."""
        ranges = {"f_number": self.facts.f_numbers, "focal_length_mm": self.facts.focal_lengths_mm}
        lowest, highest = ranges.get(name) or (getattr(self.lens, name),) * 2
        if not lowest * (1.0 - _SAME_LENS) <= got <= highest * (1.0 + _SAME_LENS):
            expected = f"{lowest:g}" if lowest == highest else f"from {lowest:g} to {highest:g}"
            raise InputError(
                f"this network was trained for a lens with {name} {expected}, but came with {got:g}: use the lens it was "
                f"trained for, or train again on focal stacks of the other one"
            )

    def _require_trained_coc(self, largest_px: float, width_px: int) -> None:
        limit_px = self.facts.largest_coc_px
        if largest_px > limit_px * _COC_SLACK:
            fitting_width_px = int(width_px * limit_px / largest_px)
            raise InputError(
                f"this network was trained for circles of confusion up to {limit_px:.1f} px, but this scene has {largest_px:.1f} px at a "
                f"width of {width_px} px: focus nearer to the object, work at most {fitting_width_px} px wide, or train again with a wider "
                f"focus range"
            )

    def _require_trained_size(self, height_px: int, width_px: int) -> None:
        if self.facts.tiled and (height_px, width_px) != (self.facts.height_px, self.facts.width_px):
            raise InputError(
                f"this network has tiles for pictures of {self.facts.width_px}x{self.facts.height_px} px, but came "
                f"{width_px}x{height_px} px: resize the picture, or train with tile_px 0 or at that size"
            )


def _white(alpha: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width 3"]:
    return np.repeat(alpha[..., None], 3, axis=2)
