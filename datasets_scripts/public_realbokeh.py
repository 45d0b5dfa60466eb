"""RealBokeh (Seizinger et al., Bokehlicious, ICCV 2025; huggingface.co/datasets/timseizinger/RealBokeh_3MP): one f/22 and several wider.

SPLIT/metadata/ID.json names the pictures (in/ID_f22.JPG, gt/ID/ID_f2.0.JPG), the f-numbers, the focal length of the zoom and the focus
distance that the camera reported, which its author calls fairly inaccurate (issue 12 of github.com/TimSeizinger/Bokehlicious).
"""

from pathlib import Path

from datasets_scripts.public_stack import PublicLens, PublicSlice, PublicStack, unlike
from mrbokeh.stacks.focal_stack_dataset import Part
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

REALBOKEH_LENS = PublicLens(50.0, 2.0, 36.0)

_SPLITS: dict[str, Part] = {"train": "train", "validation": "test", "val": "test", "test": "test"}


def realbokeh_stacks(source: Path) -> list[PublicStack]:
    """All scenes of the splits that are there."""
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
        return PublicStack(f"realbokeh_{split}/{path.stem}", _SPLITS[split], path.stem, root / facts["source_image"], slices, facts=told)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected source_image, target_images, target_avs, focal_length, focus_plane_distance as in RealBokeh_3MP ({error!r})"
        ) from None
