"""Pairs of photographs, narrow and wide open: EBB!, DPDD and folders with one picture per f-number. None of them has depth.

EBB!: Ignatov et al., Rendering Natural Camera Bokeh Effect with Deep Learning (CVPRW 2020), Canon 7D with a 50 mm f/1.8 at f/16 and f/1.8.
DPDD: Abuolaim and Brown, Defocus Deblurring Using Dual-Pixel Data (ECCV 2020), github.com/Abdullah-Abuolaim/defocus-deblurring-dual-pixel:
Canon 5D Mark IV, TRAIN_c/source blurred, TRAIN_c/target sharp; pairs have the same place in the order of names, not the same name.
"""

from collections.abc import Iterator
from pathlib import Path

from datasets_scripts.public_stack import PublicLens, PublicSlice, PublicStack, f_number_of, pictures_in, unlike
from mrbokeh.stacks.focal_stack_dataset import Part

EBB_LENS = PublicLens(50.0, 1.8, 22.3)
DPDD_LENS = PublicLens(None, 4.0, 36.0)
APERTURE_LENS = PublicLens(None, 1.8, 36.0)

_TEST_NAMES = ("test", "val", "validation")


def ebb_stacks(source: Path) -> list[PublicStack]:
    """train/original/N.jpg and train/bokeh/N.jpg; the same folders directly in `source` do as well."""
    root = source / "train" if (source / "train").is_dir() else source
    sharp = {path.stem: path for path in pictures_in(root / "original")}
    blurred = {path.stem: path for path in pictures_in(root / "bokeh")}
    both = [name for name in sharp if name in blurred]
    if not both:
        raise unlike(source, "EBB!", "train/original and train/bokeh with pictures of the same names")
    return [PublicStack(f"ebb/{name}", "train", name, sharp[name], (PublicSlice(blurred[name]),)) for name in both]


def dpdd_stacks(source: Path) -> list[PublicStack]:
    """train_c, val_c, test_c with source and target; the dual-pixel views train_l and train_r are not needed."""
    found: list[PublicStack] = []
    for split in ("train", "val", "test"):
        blurred, sharp = (pictures_in(source / f"{split}_c" / name) for name in ("source", "target"))
        if len(blurred) != len(sharp):
            raise unlike(source, "DPDD", f"as many pictures in {split}_c/source ({len(blurred)}) as in {split}_c/target ({len(sharp)})")
        pairs = zip(sharp, blurred, strict=True)
        found += [PublicStack(f"dpdd_{split}/{one.stem}", _part(split), one.stem, one, (PublicSlice(two),)) for one, two in pairs]
    if not found:
        raise unlike(source, "DPDD", "train_c/source with blurred pictures and train_c/target with sharp ones")
    return found


def aperture_stacks(source: Path) -> list[PublicStack]:
    """SCENE/...fN.jpg, or train/SCENE and test/SCENE: the picture with the largest f-number is the sharp one."""
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
        yield PublicStack(f"{folder.name}/{scene.name}", part, scene.name, numbers[narrow], slices, facts=facts)


def _part(split: str) -> Part:
    return "test" if split.lower() in _TEST_NAMES else "train"
