"""BLB (Peng et al., BokehMe, CVPR 2022; github.com/JuewenPeng/BokehMe): Blender scenes with depth, five amounts of blur, ten focuses.

SCENE/info.json holds focus_distances and blur_parameters, SCENE/image the sharp picture, SCENE/depth.exr metres (65504 is the sky),
SCENE/bokeh_LL_FF level LL focused at FF. Radius of blur in pixels = blur_parameter |1/depth - 1/focus| (issue 4 there), so a diameter
grows by twice the parameter per dioptre. JPG files were encoded with a power of 1/2.2 (the repository's Blender guide).
"""

from pathlib import Path
from typing import Any

from datasets_scripts.public_stack import PublicLens, PublicSlice, PublicStack, unlike
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

# Stated for all scenes alike, since one network learns one lens; the blur of each level is in px_per_dioptre.
BLB_LENS = PublicLens(50.0, 1.8, 36.0)

_SUFFIXES = (".exr", ".jpg", ".png")
_GAMMA = 2.2


def blb_stacks(source: Path) -> list[PublicStack]:
    """One stack per scene and level, all for testing, as the set is meant."""
    scenes = sorted(path.parent for path in source.glob("*/info.json")) or ([source] if (source / "info.json").is_file() else [])
    if not scenes:
        raise unlike(source, "BLB", "SCENE/info.json beside image.exr, depth.exr and bokeh_00_00.exr")
    return [stack for scene in scenes for stack in _levels(scene)]


def _levels(scene: Path) -> list[PublicStack]:
    info = read_json(scene / "info.json", "the description of a BLB scene")
    try:
        focuses_m, blurs = [float(each) for each in info["focus_distances"]], [float(each) for each in info["blur_parameters"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{scene / 'info.json'}: expected lists focus_distances and blur_parameters as in BLB ({error!r})") from None
    return [_level(scene, level, 2.0 * blur, focuses_m, info) for level, blur in enumerate(blurs)]


def _level(scene: Path, level: int, px_per_dioptre: float, focuses_m: list[float], info: dict[str, Any]) -> PublicStack:
    slices = tuple(
        PublicSlice(_picture(scene, f"bokeh_{level:02d}_{index:02d}"), distance_m, px_per_dioptre=px_per_dioptre)
        for index, distance_m in enumerate(focuses_m)
    )
    sharp = _picture(scene, "image")
    power = None if sharp.suffix == ".exr" else _GAMMA
    facts: dict[str, Any] = {key: info[key] for key in ("focal_length", "sensor_width", "f_stops") if key in info}
    return PublicStack(f"{scene.name}/level_{level:02d}", "test", scene.name, sharp, slices, scene / "depth.exr", power, facts)


def _picture(scene: Path, name: str) -> Path:
    """Linear where there is EXR."""
    for suffix in _SUFFIXES:
        if (scene / f"{name}{suffix}").is_file():
            return scene / f"{name}{suffix}"
    raise unlike(scene, "a BLB scene", f"{name}.exr (or .jpg)")
