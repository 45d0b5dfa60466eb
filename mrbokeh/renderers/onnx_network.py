"""A trained network (.onnx) as a Renderer, and what such a file says about itself (contract 2).

The graph takes `rgb` (B, 3, H, W) linear radiance and `coc_px` (B, 1, H, W) signed diameters and gives `blurred` (B, 3, H, W);
tiles, the sign of the circle of confusion and the range of the network are the graph's own business.
Widths: a circle of confusion means the same number of pixels whatever the picture's width, so a network without tiles takes
any width at which the blur stays within what it was trained for. Tiles belong to one size of picture.
Highlights above the radiance scale: a network that is linear in radiance takes them as they are. For any other the part above
the scale goes through the network as an exposure of its own, darkened into range and brightened again, and is added.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.errors import InputError
from mrbokeh.layer import Layer, clear, flatten
from mrbokeh.lens import Lens
from mrbokeh.lens_file import lens_from_json, lens_to_json

FORMAT = "mrbokeh-neural-bokeh"
VERSION = 1
METADATA_KEY = "mrbokeh"
_SAME_LENS = 5e-3
_COC_SLACK = 1.02
_SENSOR_BLUR_PX = 1  # a photograph is never sharper than its sensor, so light learned from it reaches a little beyond its disc


@dataclass(frozen=True)
class NetworkFacts:
    """What an exported network holds for.

    lens: its focus may change, nothing else. width_px, height_px: the pictures it was trained on; the only size when tiled.
    largest_coc_px: the largest diameter it was trained for. radiance_scale: top of its range.
    reach_px: how far from a pixel the network looks. commit: of the training code, or None.
    trained_on: names of the stacks.
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

    def to_json(self) -> str:
        return json.dumps({"format": FORMAT, "version": VERSION, **vars(self), "lens": lens_to_json(self.lens)})


def facts_from_json(text: str, where: str) -> NetworkFacts:
    document: dict[str, Any] = json.loads(text)
    if document.pop("format", None) != FORMAT or document.pop("version", None) != VERSION:
        raise InputError(f"{where}: expected a network of format {FORMAT!r} version {VERSION}: export it again with `mrbokeh train export`")
    lens = lens_from_json(document.pop("lens"), where)
    return NetworkFacts(lens=lens, trained_on=tuple(document.pop("trained_on")), **document)


class OnnxNetwork:
    """A Renderer that blurs as the lens it learned from; it refuses what it was not trained for.

    threads: of ONNX Runtime, 0 takes all cores.
    """

    def __init__(self, path: Path, threads: int = 0) -> None:
        import onnxruntime

        if not Path(path).is_file():
            raise InputError(
                f"expected a network at {path}, but there is no such file: make one with `mrbokeh train export RUN --out {path}`"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        wanted = ("CUDAExecutionProvider", "CPUExecutionProvider")
        providers = [each for each in wanted if each in onnxruntime.get_available_providers()]
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=providers)
        except Exception as error:  # onnxruntime has no common base class for "this is not a model"
            raise InputError(f"{path} cannot be opened as an ONNX network: {str(error)[:200]}") from None
        stored = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        if stored is None:
            raise InputError(f"{path} does not say which lens it was trained for: export it with `mrbokeh train export`")
        self.facts = facts_from_json(stored, str(path))

    @property
    def lens(self) -> Lens:
        """The lens it was trained for, with the focus of its first training slice."""
        return self.facts.lens

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        """See Renderer. The aperture of `lens` has no say: the network learned its own. Extra channels are left out."""
        self._require_trained_lens(lens)
        return flatten([self._blurred_layer(layer, lens) for layer in layers])

    def blur(
        self, rgb: Float32[np.ndarray, "height width 3"], coc_px: Float32[np.ndarray, "height width"]
    ) -> Float32[np.ndarray, "height width 3"]:
        """An opaque picture with a signed circle of confusion (diameter) per pixel, blurred; linear radiance of any height."""
        self._require_trained_size(*coc_px.shape)
        scale = np.float32(self.facts.radiance_scale)
        excess = np.maximum(rgb - scale, 0.0)
        if self.facts.linear_in_radiance or not excess.any():
            return self._run(rgb, coc_px)
        brightest = excess.max()
        black = self._run(np.zeros_like(rgb), coc_px)
        highlights = self._run(excess * (scale / brightest), coc_px) - black
        return self._run(np.minimum(rgb, scale), coc_px) + highlights * (brightest / scale)

    def _run(self, rgb: np.ndarray, coc_px: np.ndarray) -> np.ndarray:
        feed = {"rgb": np.ascontiguousarray(rgb.transpose(2, 0, 1))[None], "coc_px": np.ascontiguousarray(coc_px)[None, None]}
        return np.ascontiguousarray(self._session.run(["blurred"], feed)[0][0].transpose(1, 2, 0))

    def _blurred_layer(self, layer: Layer, lens: Lens) -> Layer:
        """Colour and coverage through the same network, cropped to where the layer can reach; outside that it stays empty."""
        covered = layer.alpha > 0
        if not covered.any():
            return clear(layer.height_px, layer.width_px)
        coc_px = lens.coc_px(_depth_around(layer.depth_m, covered), layer.width_px).astype(np.float32)
        largest_px = float(np.abs(coc_px).max())
        self._require_trained_coc(largest_px, layer.width_px)
        reached = _grown(covered, int(np.ceil(largest_px / 2.0)) + _SENSOR_BLUR_PX)
        window = np.s_[:, :] if self.facts.tiled else _window(reached, self.facts.reach_px)
        rgb, alpha = np.zeros_like(layer.rgb), np.zeros_like(layer.alpha)
        rgb[window] = self.blur(layer.rgb[window], coc_px[window])
        whole = bool((layer.alpha[window] == 1).all())
        alpha[window] = 1.0 if whole else self._blurred_coverage(layer.alpha[window], coc_px[window])
        return Layer(np.maximum(rgb, 0) * reached[..., None], alpha * reached, layer.depth_m)

    def _blurred_coverage(self, alpha: np.ndarray, coc_px: np.ndarray) -> np.ndarray:
        """Coverage seen as white light of radiance 1, so that it spreads as the colours do."""
        return self.blur(np.repeat(alpha[..., None], 3, axis=2), coc_px).mean(axis=2).clip(0.0, 1.0)

    def _require_trained_lens(self, lens: Lens) -> None:
        trained = self.facts.lens
        for name in ("focal_length_mm", "f_number", "sensor_width_mm"):
            expected, got = getattr(trained, name), getattr(lens, name)
            if abs(got / expected - 1.0) > _SAME_LENS:
                raise InputError(
                    f"this network was trained for a lens with {name} {expected:g}, but came with {got:g}: use the lens it was "
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


def _depth_around(
    depth_m: Float32[np.ndarray, "height width"], covered: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """Depth with every uncovered pixel given that of the nearest covered one, so that blur can spread beyond the silhouette."""
    from scipy.ndimage import distance_transform_edt

    if covered.all():
        return depth_m
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return depth_m[tuple(nearest)]


def _grown(covered: Bool[np.ndarray, "height width"], radius_px: int) -> Bool[np.ndarray, "height width"]:
    from scipy.ndimage import distance_transform_edt

    return covered if covered.all() else distance_transform_edt(~covered) <= radius_px + 0.5


def _window(reached: Bool[np.ndarray, "height width"], margin_px: int) -> tuple[slice, slice]:
    """The rectangle around everything reached, with what the network must see around it."""
    rows, columns = np.flatnonzero(reached.any(axis=1)), np.flatnonzero(reached.any(axis=0))
    return tuple(slice(max(0, int(each[0]) - margin_px), int(each[-1]) + 1 + margin_px) for each in (rows, columns))  # type: ignore[return-value]
