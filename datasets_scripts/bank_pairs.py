"""Focal stacks blurred by a bank of kernels, to train a network on a measured lens.

    mrbokeh lens fit STACK... --out BANK
    python -m datasets_scripts.bank_pairs BANK --out DATASET [--scenes 10 --focuses 5 --lens lens.json]
    mrbokeh train fit DATASET --out RUN

Random layered scenes, discs and bars of texture before a wall with lamps, are rendered with the exact kernels of the bank
(`ScatterReference`), each focused at several distances. What is hard in photographs is exact here: all-in-focus picture and depth.
Finished files are kept; an interrupted run goes on where it stopped.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Bool, Float32

from datasets_scripts.made_sets.set_files import (
    LICENCE,
    Overwrite,
    claim_set,
    distant_camera,
    even_in_dioptres,
    focus_index,
    mistakes_told,
    slice_name,
    stack_record,
    write_dataset,
)
from datasets_scripts.scenes.textures import checks, mottled, wood
from datasets_scripts.tracers.traced_scene import Texture
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.layer import Layer, flatten, opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens, write_lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.optics.psf_bank_file import read_bank
from mrbokeh.renderers.bank.kernel_files import fingerprint
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import FILE_NAME, FocalStack, Slice, write_focal_stack, write_merged
from mrbokeh.stacks.focal_stack_dataset import FocalStackDataset
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

NEAREST_M, FARTHEST_M = 0.9, 6.5
_TEXTURES: tuple[Callable[..., Texture], ...] = (mottled, wood, checks)
_LAMPS, _LAMP_RADIANCE = 12, (20.0, 60.0)
_SHAPES = (3, 7)  # least and most, exclusive
_TEST_SHARE = 0.2
_MOST_BLUR = 0.98  # of what the bank holds
_SOME_LENS = Lens(focal_length_mm=50.0, f_number=1.0, focus_distance_m=NEAREST_M, sensor_width_mm=36.0, aperture=Aperture.disc())


@dataclass(frozen=True)
class PairsPlan:
    """Settings of a set; equal plans and banks give equal pictures. The last fifth of the scenes, at least one of several, is tested."""

    scenes: int = 10
    focuses: int = 5
    width_px: int = 192
    height_px: int = 112
    seed: int = 1

    def __post_init__(self) -> None:
        if self.scenes < 1 or self.focuses < 1 or min(self.width_px, self.height_px) < 16:
            raise InputError(
                f"a set needs at least one scene, one focus and pictures of 16x16 px, got {self.scenes} scenes, {self.focuses} "
                f"focuses and {self.width_px}x{self.height_px} px"
            )

    @property
    def names(self) -> list[str]:
        return [f"layers_{number:03d}/view_00" for number in range(self.scenes)]

    @property
    def tested(self) -> set[str]:
        return set(self.names[self.scenes - max(round(_TEST_SHARE * self.scenes), int(self.scenes > 1)) :]) if self.scenes > 1 else set()

    @property
    def focus_distances_m(self) -> tuple[float, ...]:
        return even_in_dioptres(NEAREST_M, FARTHEST_M, self.focuses)


def make_bank_pairs(bank: PsfBank, out: Path, plan: PairsPlan, lens: Lens | None = None, *, overwrite: bool = False) -> FocalStackDataset:
    """Write what is missing of a set, the manifest last. lens: None takes one whose largest blur is what the bank holds.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace its files.
    """
    used = lens or _fitting_lens(bank, plan)
    document = {"plan": asdict(plan), "bank": fingerprint(bank.kernels), "f_number": used.f_number}
    claim_set(out, document, [out / name / FILE_NAME for name in plan.names], overwrite)
    write_lens(out / "lens.json", used)
    renderer = ScatterReference(bank=bank)
    for number, name in enumerate(track(plan.names, "blurring scenes")):
        if not (out / name / FILE_NAME).is_file():
            _make_stack(out / name, plan, number, used, renderer)
    records = tuple(stack_record(out, name, "test" if name in plan.tested else "train") for name in plan.names)
    metadata = {"made_by": "datasets_scripts.bank_pairs", "plan": asdict(plan), "bank": fingerprint(bank.kernels), "model": bank.model}
    return write_dataset(out, LICENCE, records, metadata)


def _make_stack(folder: Path, plan: PairsPlan, number: int, lens: Lens, renderer: ScatterReference) -> None:
    layers = random_layers((plan.height_px, plan.width_px), np.random.default_rng([plan.seed, number]))
    sharp, distances_m = flatten(layers), plan.focus_distances_m
    for index, distance_m in enumerate(distances_m):
        blurred = renderer.render(layers, lens.focused_at(distance_m))
        write_camera_rgb(folder / slice_name(index), blurred.rgb, None)
    write_merged(folder, sharp.rgb, focus_index(sharp.depth_m, distances_m), np.ones_like(sharp.depth_m), sharp.depth_m)
    camera = distant_camera(lens, plan.width_px, plan.height_px)
    slices = tuple(Slice(slice_name(index), distance_m) for index, distance_m in enumerate(distances_m))
    write_focal_stack(FocalStack(folder, slices, lens.focused_at(distances_m[0]), camera, registered=True, merged=True))


def _fitting_lens(bank: PsfBank, plan: PairsPlan) -> Lens:
    """Return the f-number at which the largest circle of confusion of any scene is nearly the bank's."""
    high_px = next((axis.high for axis in bank.axes if axis.name == "diameter_px"), None)
    if high_px is None:
        raise InputError("expected a bank over diameter, as `mrbokeh lens fit` writes it")
    ends_m = np.array([NEAREST_M, FARTHEST_M])
    largest = max(float(np.abs(_SOME_LENS.focused_at(each).coc_px(ends_m, plan.width_px)).max()) for each in plan.focus_distances_m)
    return replace(_SOME_LENS, f_number=_SOME_LENS.f_number * largest / (_MOST_BLUR * high_px))


def random_layers(size_px: tuple[int, int], rng: np.random.Generator) -> list[Layer]:
    """Return layers (height, width), front first, each of one depth, the last a slanted opaque wall. A pixel has one depth."""
    dioptres = np.sort(rng.uniform(1.0 / FARTHEST_M, 1.0 / NEAREST_M, int(rng.integers(*_SHAPES)) + 1))[::-1]
    shapes = [_card(size_px, float(1.0 / each), rng) for each in dioptres[:-1]]
    return [*shapes, _wall(size_px, float(dioptres[-1]), rng)]


def _card(size_px: tuple[int, int], depth_m: float, rng: np.random.Generator) -> Layer:
    inside = _disc(size_px, rng) if rng.random() < 0.5 else _bar(size_px, rng)
    rgb = np.where(inside[..., None], _texture(size_px, rng), np.float32(0.0))
    return Layer(rgb, inside.astype(np.float32), np.where(inside, np.float32(depth_m), np.float32(np.inf)).astype(np.float32))


def _wall(size_px: tuple[int, int], dioptres: float, rng: np.random.Generator) -> Layer:
    """Return a wall slanted by up to a tenth of its distance, with lamps of one pixel."""
    across = np.linspace(-0.1, 0.1, size_px[1]) * rng.uniform(-1.0, 1.0)
    rgb = _texture(size_px, rng)
    rows, columns = (rng.integers(0, length, _LAMPS) for length in size_px)
    rgb[rows, columns] = rng.uniform(*_LAMP_RADIANCE, (_LAMPS, 1)) * rng.uniform(0.4, 1.0, (_LAMPS, 3))
    depth_m = np.clip((1.0 + across) / dioptres, NEAREST_M, FARTHEST_M)
    return opaque(rgb, np.broadcast_to(depth_m, size_px).astype(np.float32))


def _disc(size_px: tuple[int, int], rng: np.random.Generator) -> Bool[np.ndarray, "height width"]:
    rows, columns = np.indices(size_px) + 0.5
    return np.asarray(
        np.hypot(rows - rng.uniform(0, size_px[0]), columns - rng.uniform(0, size_px[1])) < size_px[0] * rng.uniform(0.1, 0.3)
    )


def _bar(size_px: tuple[int, int], rng: np.random.Generator) -> Bool[np.ndarray, "height width"]:
    rows, columns = np.indices(size_px) + 0.5
    angle_rad, row, column = rng.uniform(0.0, np.pi), rng.uniform(0, size_px[0]), rng.uniform(0, size_px[1])
    away = (columns - column) * np.sin(angle_rad) - (rows - row) * np.cos(angle_rad)
    return np.asarray(np.abs(away) < size_px[0] * rng.uniform(0.01, 0.08))


def _texture(size_px: tuple[int, int], rng: np.random.Generator) -> Float32[np.ndarray, "height width 3"]:
    colours = rng.uniform(0.05, 0.9, (2, 3))
    whole = _TEXTURES[int(rng.integers(len(_TEXTURES)))](max(size_px), rng, tuple(colours[0]), tuple(colours[1]))
    return np.ascontiguousarray(whole[: size_px[0], : size_px[1]]).astype(np.float32)


def main(
    bank: Annotated[Path, typer.Argument(help="Bank of PSFs, as `mrbokeh lens fit` or `mrbokeh lens psf` writes it.")],
    out: Annotated[Path, typer.Option(help="Folder for the set.")],
    scenes: Annotated[int, typer.Option(help="How many.", min=1)] = 10,
    focuses: Annotated[int, typer.Option(help="Slices of each.", min=1)] = 5,
    width: Annotated[int, typer.Option(help="Of the pictures, px.", min=16)] = 192,
    height: Annotated[int, typer.Option(help="Of the pictures, px.", min=16)] = 112,
    lens: Annotated[Path | None, typer.Option(help="Lens file whose blur the bank describes; without it one that fits it.")] = None,
    seed: Annotated[int, typer.Option(help="Of the scenes.")] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Render the missing stacks of a set by a bank of kernels."""
    with mistakes_told():
        plan = PairsPlan(scenes=scenes, focuses=focuses, width_px=width, height_px=height, seed=seed)
        dataset = make_bank_pairs(read_bank(bank), out, plan, None if lens is None else read_lens(lens), overwrite=overwrite)
    typer.echo(f"{out}: {len(dataset.stacks)} stacks, largest circle of confusion {dataset.largest_coc_px:.1f} px")


if __name__ == "__main__":
    typer.run(main)
