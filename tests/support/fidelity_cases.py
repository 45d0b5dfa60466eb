"""Pictures with a known defocused truth: the card scene, and folders written by datasets_scripts/render_truth.py."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, grey_dilation

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image
from mrbokeh.images.image_metrics import depth_edge_mask, energy_ratio, psnr
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.system.atomic_files import read_json
from tests.support import card_scene as cards

CARD_RADII_PX = (12, 32)
_EDGE_REACH_PX = 4
_CARD_EDGE_DIOPTRES, _TRUTH_EDGE_DIOPTRES = 0.02, 0.05
_LAMP_RADIANCE = 3.0  # no texture of these scenes is brighter than 1


@dataclass(frozen=True, eq=False)
class Case:
    """One blurred truth and what a renderer gets to make it.

    group: "cards 12 px", "cards 32 px", "thin" or "open". layers: more than one, front first, or none.
    display: whether pictures are compared as they are shown (clipped, sRGB-encoded) instead of as clipped linear light.
    """

    name: str
    group: str
    shape: str
    picture: Layer
    layers: Sequence[Layer]
    lens: Lens
    truth: np.ndarray
    display: bool

    def measure(self, result: np.ndarray) -> dict[str, float]:
        """PSNR over the frame, near depth edges and around lights (nan where there are none), and the energy ratio."""
        shown, truth = (linear_to_srgb(each) if self.display else each for each in (result, self.truth))
        edges, lights = self._edges(), self._round_lights()
        return {
            "frame": psnr(shown, truth),
            "edges": psnr(shown, truth, mask=edges) if edges.any() else np.nan,
            "lights": psnr(shown, truth, mask=lights) if lights.any() else np.nan,
            "energy": energy_ratio(result, self.truth),
        }

    def _edges(self) -> np.ndarray:
        step = _CARD_EDGE_DIOPTRES if self.display else _TRUTH_EDGE_DIOPTRES
        return depth_edge_mask(self.picture.depth_m, _EDGE_REACH_PX, step)

    def _round_lights(self) -> np.ndarray:
        """The pixels that a light reaches, by its own circle of confusion, and two more."""
        coc_px = self.lens.coc_px(self.picture.depth_m, self.picture.width_px)
        sources = self.picture.rgb.max(axis=-1) > _LAMP_RADIANCE
        reach_px = np.where(grey_dilation(sources, (3, 3)), np.abs(coc_px) / 2 + 2.0, 0.0)
        reached = np.zeros(sources.shape, bool)
        for radius_px in np.unique(np.ceil(reach_px[sources])):
            y, x = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
            reached |= binary_dilation(sources & (np.ceil(reach_px) == radius_px), np.hypot(x, y) <= radius_px)
        return reached


def card_cases(seeds: Sequence[int], kept: Path | None) -> Iterator[Case]:
    """The card scenes focused on the card in focus, disc aperture; their truths are kept in a folder where one is given."""
    for seed in seeds:
        scene = cards.card_scene(seed)
        picture, layers = opaque(cards.all_in_focus(scene), cards.depth_m(scene)), cards.layers(scene)
        for radius_px in CARD_RADII_PX:
            lens = cards.lens_of_radius(float(radius_px), scene.width_px)
            file = None if kept is None else kept / f"cards_{seed}_{radius_px}px.exr"
            if file is None or not file.is_file():
                truth = cards.truth(scene, lens)
                if file is not None:
                    file.parent.mkdir(parents=True, exist_ok=True)
                    write_image(file, truth, half=False)
            else:
                truth = read_image(file)
            yield Case(f"cards {seed}", f"cards {radius_px} px", "disc", picture, layers, lens, truth, display=True)


def truth_cases(folder: Path) -> Iterator[Case]:
    """All finished truths under a folder of scenes and views; equal apertures are one object, whose tables renderers keep."""
    known: dict[str, Aperture] = {}
    for meta_path in sorted(folder.glob("*/*/meta.json")):
        view, meta = meta_path.parent, read_json(meta_path, "the description of a view")
        if not (view / "depth.exr").is_file():
            continue
        depth = read_exr(view / "depth.exr")[0].stacked("Z")[..., 0]
        picture = opaque(read_image(view / "all_in_focus.exr"), depth)
        layer_paths = [view / each for each in meta["layers"]]
        layers = [read_layer(path) for path in layer_paths] if all(path.is_file() for path in layer_paths) else []
        for shape, files in meta["truth"].items():
            document = meta["apertures"][shape]
            aperture = known.setdefault(json.dumps(document), _aperture(document))
            for file, focus_m in zip(files, meta["focus_distances_m"], strict=True):
                if (view / file).is_file():
                    lens = Lens(**meta["lens"], focus_distance_m=focus_m, aperture=aperture)
                    name = f"{view.parent.name}/{Path(file).stem}"
                    yield Case(name, meta["kind"], shape, picture, layers, lens, read_image(view / file), display=False)


def _aperture(document: dict) -> Aperture:
    outlines = tuple(np.asarray(outline, np.float64) for outline in document["outlines"])
    return Aperture(outlines, tuple(document["weights"]), cat_eye=document["cat_eye"])
