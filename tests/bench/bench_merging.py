"""How good, fast and large merging is beside other tools: `python -m tests.bench.bench_merging [--lab DIR] [--focusweave PROGRAM]`.

Picture: a ray-traced RAW stack of the lab (960x640 px, 12 slices, jitter of 1.2 px and 0.03 degrees, 1 % shot noise, a dark card
of point lights), PSNR in linear light clipped to 1 against the pinhole truth, without the outermost 2 % of the picture, all of
it and on the card alone. The peers get our registered slices as linear 16-bit TIFF, so that all stand in one reference frame:
FocusWeave (PyPI) and enfuse (Debian). Second passes are guided by the true depth (the best that any depth can do) and by the
depth from focus alone. "nearest slice" takes each pixel from the slice whose focus is nearest to its true depth; "best slice"
from the slice that happens to be nearest to the truth, which no method can know.
Speed: the same tools from photographs on disk to pictures on disk, with registration; CPU seconds of all cores together.
"""

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np

from capture.merging.second_pass import SliceOptics, second_pass
from datasets_scripts.made_sets.simulated_camera import SensorModel
from datasets_scripts.make_raw_stack import StackPlan, make_raw_stack
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from tests.bench.machine import machine_line
from tests.bench.process_cost import measured, mrbokeh
from tests.support.capture_truth import ViewTruth, picture_db, view_truth

LAB = Path("bench_out") / "lab"
PHOTOGRAPHS = Path(__file__).resolve().parents[3] / "shared" / "data" / "stacks" / "button_macro"
ENFUSE = ("enfuse", "--exposure-weight=0", "--saturation-weight=0", "--contrast-weight=1", "--hard-mask")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lab", type=Path, default=LAB, help="the traced stack; made where it is missing (tens of minutes)")
    parser.add_argument("--focusweave", default="focusweave", help="the program, where it is not on the path")
    options = parser.parse_args()
    peers = {"FocusWeave": options.focusweave, "enfuse": ENFUSE[0]}
    present = {name: program for name, program in peers.items() if shutil.which(program)}
    for name in peers.keys() - present.keys():
        print(f"{name} is left out: there is no program {peers[name]!r} here (pip install focusweave; apt-get install enfuse hugin-tools)")
    with tempfile.TemporaryDirectory() as folder:
        quality(options.lab, Path(folder), present)
        if PHOTOGRAPHS.is_dir():
            speed(Path(folder), present)
        else:
            print(f"speed is left out: {PHOTOGRAPHS} is not there")
    print(machine_line())


def quality(lab: Path, folder: Path, peers: dict[str, str]) -> None:
    if not (lab / "view_0" / "slice_11.dng").is_file():
        plan = StackPlan(1, 12, 960, 640, 1, 64, SensorModel(full_well_electrons=1e4), "lab", 1, 1.2, 0.03)
        make_raw_stack(lab, plan)
    truth = view_truth(lab, 0)
    mrbokeh("capture", "ingest", lab / "view_0", "--out", folder / "lab")
    cpu_s, memory_mb = mrbokeh("capture", "merge", folder / "lab")
    stack = read_focal_stack(folder / "lab" / "view_0")
    slices = list(stack.iter_rgb())
    print(f"{'12 slices of 960x640 px':34s} {'all':>6s} {'card':>6s}   CPU s     MB")
    row("mrbokeh, first pass", stack.all_in_focus(), truth, cpu_s, memory_mb)
    row("mrbokeh, second pass, true depth", stack.to_rec709(second_pass(stack, truth.depth_m)), truth)
    row("mrbokeh, second pass, own depth", stack.to_rec709(second_pass(stack, stack.depth_m())), truth)
    for index, rgb in enumerate(slices):
        write_image(folder / "tiff" / f"{index:02d}.tif", rgb, "linear")
    for name, program in peers.items():
        cpu_s, memory_mb = measured(command_of(name, program, sorted((folder / "tiff").iterdir()), folder / f"{name}.tif", aligned=True))
        row(name, read_image(folder / f"{name}.tif", "linear"), truth, cpu_s, memory_mb)
    row("nearest slice", picked(slices, blur_of(stack, truth)), truth)
    row("best slice", picked(slices, [np.abs(np.clip(rgb, 0, 1) - np.clip(truth.rgb, 0, 1)).sum(axis=2) for rgb in slices]), truth)


def speed(folder: Path, peers: dict[str, str]) -> None:
    photographs = sorted(PHOTOGRAPHS.glob("[0-9]*.jpg"))
    height, width = read_image(photographs[0]).shape[:2]
    print(f"{len(photographs)} photographs of {width}x{height} px, registered and merged:")
    mrbokeh("capture", "ingest", *photographs, "--out", folder / "photographs")
    ours_s, memory_mb = mrbokeh("capture", "merge", folder / "photographs")
    print(f"  mrbokeh: {ours_s:.1f} CPU s, {memory_mb:.0f} MB")
    jpeg = [shutil.copy(path, folder / path.name) for path in photographs]
    for name, program in peers.items():
        cpu_s, memory_mb = measured(command_of(name, program, [Path(path) for path in jpeg], folder / f"{name}.jpg", aligned=False))
        print(f"  {name}: {cpu_s:.1f} CPU s, {memory_mb:.0f} MB; mrbokeh takes {ours_s / cpu_s:.2f} of its time")


def command_of(name: str, program: str, pictures: list[Path], result: Path, *, aligned: bool) -> list[str]:
    """How a peer merges pictures; for enfuse align_image_stack (Hugin) goes before, where they are not aligned yet."""
    if name == "FocusWeave":
        source = pictures[0].parent
        if source.parent == result.parent.parent:  # the folder that holds other things too
            source = result.parent / "focusweave"
            source.mkdir()
            for path in pictures:
                shutil.copy(path, source)
        return [program, str(source), "--output", str(result), *(["--no-align", "--keep-size"] if aligned else [])]
    names = " ".join(map(str, pictures))
    fuse = f"{' '.join((program, *ENFUSE[1:]))} -o {result}"
    if aligned:
        return ["sh", "-c", f"{fuse} {names}"]
    return ["sh", "-c", f"align_image_stack -m -a {result.parent}/aligned_ {names} && {fuse} {result.parent}/aligned_*.tif"]


def blur_of(stack: FocalStack, truth: ViewTruth) -> list[np.ndarray]:
    optics = SliceOptics.of_stack(stack, truth.depth_m.shape[1])
    return [np.abs(optics.coc_px(index, 1.0 / truth.depth_m)) for index in range(len(stack))]


def picked(slices: list[np.ndarray], costs: list[np.ndarray]) -> np.ndarray:
    """Every pixel from the slice that costs least there."""
    chosen = np.argmin(costs, axis=0)
    return np.take_along_axis(np.stack(slices), chosen[None, ..., None], axis=0)[0]


def row(name: str, picture: np.ndarray, truth: ViewTruth, cpu_s: float | None = None, memory_mb: float | None = None) -> None:
    dbs = f"{picture_db(picture, truth.rgb, truth.inner):6.2f} {picture_db(picture, truth.rgb, truth.inner & truth.card):6.2f}"
    print(f"{name:34s} {dbs}" + ("" if cpu_s is None or memory_mb is None else f"  {cpu_s:6.1f} {memory_mb:6.0f}"))


if __name__ == "__main__":
    main()
