"""Adapters of public data sets: the files of each stack, found in its folder before any picture is read.

EBB!: Ignatov et al., Rendering Natural Camera Bokeh Effect with Deep Learning (CVPRW 2020), Canon 7D with a 50 mm f/1.8 at f/16 and f/1.8.

DPDD: Abuolaim and Brown, Defocus Deblurring Using Dual-Pixel Data (ECCV 2020), github.com/Abdullah-Abuolaim/defocus-deblurring-dual-pixel:
Canon 5D Mark IV, TRAIN_c/source blurred, TRAIN_c/target sharp; pairs have the same place in the order of names, not the same name.

RealBokeh: Seizinger et al., Bokehlicious (ICCV 2025), huggingface.co/datasets/timseizinger/RealBokeh_3MP, one f/22 and several wider.
SPLIT/metadata/ID.json names the pictures (in/ID_f22.JPG, gt/ID/ID_f2.0.JPG), the f-numbers, the focal length of the zoom and the focus
distance that the camera reported, which its author calls fairly inaccurate (issue 12 of github.com/TimSeizinger/Bokehlicious).

BLB: Peng et al., BokehMe (CVPR 2022), github.com/JuewenPeng/BokehMe, Blender scenes with depth, five amounts of blur, ten focuses.
SCENE/info.json holds focus_distances and blur_parameters, SCENE/image the sharp picture, SCENE/depth.exr metres (65504 is the sky),
SCENE/bokeh_LL_FF level LL focused at FF. Radius of blur in pixels = blur_parameter |1/depth - 1/focus| (issue 4 there), so a diameter
grows by twice the parameter per dioptre. JPG files were encoded with a power of 1/2.2 (the repository's Blender guide).
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrbokeh.images.image_io import INTEGER_SUFFIXES, LINEAR_SUFFIXES
from mrbokeh.stacks.focal_stack_dataset import Part
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

_PICTURES = (*INTEGER_SUFFIXES, *LINEAR_SUFFIXES)
_F_NUMBER = re.compile(r"(?:^|[^a-z0-9])f[_/-]?(\d+(?:\.\d+)?)$", re.IGNORECASE)
_TEST_NAMES = ("test", "val", "validation")
_SPLITS: dict[str, Part] = {"train": "train", "validation": "test", "val": "test", "test": "test"}
_SUFFIXES = (".exr", ".jpg", ".png")
_GAMMA = 2.2


@dataclass(frozen=True)
class PublicLens:
    """The lens of a set. focal_length_mm None: nobody knows, the user must say."""

    focal_length_mm: float | None
    f_number: float
    sensor_width_mm: float


@dataclass(frozen=True)
class PublicSlice:
    """A photograph or rendering with blur.

    focus_distance_m: None where it has to be found from what is sharp. f_number, focal_length_mm: None as the lens of the set.
    px_per_dioptre: diameters of blur, at the width of the picture, where the set says it; else it follows from the lens.
    """

    path: Path
    focus_distance_m: float | None = None
    f_number: float | None = None
    focal_length_mm: float | None = None
    px_per_dioptre: float | None = None


@dataclass(frozen=True)
class PublicStack:
    """One viewpoint. name: SCENE/VIEW. key: what its file in a folder of depth maps is called. depth: a file of the set itself, metres.

    power: the pictures are linear to this power (a gamma without sRGB's toe); None: sRGB, or linear in EXR.
    """

    name: str
    part: Part
    key: str
    sharp: Path
    slices: tuple[PublicSlice, ...]
    depth: Path | None = None
    power: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)


def pictures_in(folder: Path) -> list[Path]:
    """Return pictures sorted by number where names are numbers, else by name."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES] if folder.is_dir() else []
    return sorted(found, key=lambda path: (int(path.stem) if path.stem.isdigit() else -1, path.name))


def unlike(source: Path, kind: str, expected: str) -> InputError:
    """Return the mistake of a folder that does not look like the set; layouts differ from version to version of a set."""
    return InputError(
        f"{source} does not look like {kind}: expected {expected}; versions of the set differ, so rename or link its folders to look so"
    )


def f_number_of(path: Path) -> float | None:
    """Return the f-number that a name ends in: f2.8.jpg, 12_f22.JPG, scene_f-16.png."""
    found = _F_NUMBER.search(path.stem)
    return float(found[1]) if found else None


EBB_LENS = PublicLens(50.0, 1.8, 22.3)


DPDD_LENS = PublicLens(None, 4.0, 36.0)


APERTURE_LENS = PublicLens(None, 1.8, 36.0)


def ebb_stacks(source: Path) -> list[PublicStack]:
    """Find train/original/N.jpg and train/bokeh/N.jpg; the same folders directly in `source` do as well."""
    root = source / "train" if (source / "train").is_dir() else source
    sharp = {path.stem: path for path in pictures_in(root / "original")}
    blurred = {path.stem: path for path in pictures_in(root / "bokeh")}
    both = [name for name in sharp if name in blurred]
    if not both:
        raise unlike(source, "EBB!", "train/original and train/bokeh with pictures of the same names")
    return [
        PublicStack(name=f"ebb/{name}", part="train", key=name, sharp=sharp[name], slices=(PublicSlice(blurred[name]),)) for name in both
    ]


def dpdd_stacks(source: Path) -> list[PublicStack]:
    """Find train_c, val_c, test_c with source and target; the dual-pixel views train_l and train_r are not needed."""
    found: list[PublicStack] = []
    for split in ("train", "val", "test"):
        blurred, sharp = (pictures_in(source / f"{split}_c" / name) for name in ("source", "target"))
        if len(blurred) != len(sharp):
            raise unlike(source, "DPDD", f"as many pictures in {split}_c/source ({len(blurred)}) as in {split}_c/target ({len(sharp)})")
        pairs = zip(sharp, blurred, strict=True)
        found += [
            PublicStack(name=f"dpdd_{split}/{one.stem}", part=_part(split), key=one.stem, sharp=one, slices=(PublicSlice(two),))
            for one, two in pairs
        ]
    if not found:
        raise unlike(source, "DPDD", "train_c/source with blurred pictures and train_c/target with sharp ones")
    return found


def aperture_stacks(source: Path) -> list[PublicStack]:
    """Find SCENE/...fN.jpg, or train/SCENE and test/SCENE: the picture with the largest f-number is the sharp one."""
    found = list(_by_f_number(source, "train"))
    for folder in sorted(path for path in source.iterdir() if path.is_dir()) if source.is_dir() else []:
        found += _by_f_number(folder, _part(folder.name))
    if not found:
        raise unlike(
            source, "pictures by aperture", "folders of scenes with two or more pictures whose names end in their f-number (f2.8.jpg)"
        )
    return found


def _by_f_number(folder: Path, part: Part) -> Iterator[PublicStack]:
    for scene in sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []:
        numbers = {number: path for path in pictures_in(scene) if (number := f_number_of(path)) is not None}
        if len(numbers) < 2:
            continue
        narrow = max(numbers)
        slices = tuple(PublicSlice(path, f_number=number) for number, path in sorted(numbers.items()) if number != narrow)
        facts = {"sharp_f_number": narrow}
        yield PublicStack(name=f"{folder.name}/{scene.name}", part=part, key=scene.name, sharp=numbers[narrow], slices=slices, facts=facts)


def _part(split: str) -> Part:
    return "test" if split.lower() in _TEST_NAMES else "train"


REALBOKEH_LENS = PublicLens(50.0, 2.0, 36.0)


def realbokeh_stacks(source: Path) -> list[PublicStack]:
    """Find all scenes of the splits that are there."""
    files = [(split, path) for split in _SPLITS for path in sorted((source / split / "metadata").glob("*.json"))]
    if not files:
        raise unlike(source, "RealBokeh", "train/metadata/ID.json, with the pictures that it names in train/in and train/gt")
    return [_stack(source / split, split, path) for split, path in files]


def _stack(root: Path, split: str, path: Path) -> PublicStack:
    facts = read_json(path, "the metadata of a RealBokeh scene")
    try:
        distance_m, focal_length_mm = float(facts["focus_plane_distance"]), float(facts["focal_length"])
        targets = zip(facts["target_images"], facts["target_avs"], strict=True)
        slices = tuple(PublicSlice(root / name, distance_m, float(number), focal_length_mm) for name, number in targets)
        told = {key: facts[key] for key in ("source_av", "focus_plane_uncertainty", "ISO", "EV") if key in facts}
        return PublicStack(
            name=f"realbokeh_{split}/{path.stem}",
            part=_SPLITS[split],
            key=path.stem,
            sharp=root / facts["source_image"],
            slices=slices,
            facts=told,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected source_image, target_images, target_avs, focal_length, focus_plane_distance as in RealBokeh_3MP ({error!r})"
        ) from None


# Stated for all scenes alike, since one network learns one lens; the blur of each level is in px_per_dioptre.
BLB_LENS = PublicLens(50.0, 1.8, 36.0)


def blb_stacks(source: Path) -> list[PublicStack]:
    """Find one stack per scene and level, all for testing, as the set is meant."""
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
    return PublicStack(
        name=f"{scene.name}/level_{level:02d}",
        part="test",
        key=scene.name,
        sharp=sharp,
        slices=slices,
        depth=scene / "depth.exr",
        power=power,
        facts=facts,
    )


def _picture(scene: Path, name: str) -> Path:
    """Return a picture's file, linear where there is EXR."""
    for suffix in _SUFFIXES:
        if (scene / f"{name}{suffix}").is_file():
            return scene / f"{name}{suffix}"
    raise unlike(scene, "a BLB scene", f"{name}.exr (or .jpg)")
