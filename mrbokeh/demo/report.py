"""Report of the demo: report.html with pictures of every stage, times and versions, and what was measured against the truth."""

import csv
import html
import os
import platform
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh import __version__
from mrbokeh.demo.plan import BOARD, BOARD_VIEWS, DATA, DESK, HELD_OUT_VIEW, VIEWS, Placement
from mrbokeh.demo.stages import Done
from mrbokeh.figures.stack_pictures import depth_picture, write_stack_pictures
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image, read_layer, write_image, write_preview
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.html_page import cell, section, table, write_page

FIRST_PASS_FOLDER = "first_pass"

TRUSTED = 0.3
LEAST_ALL_IN_FOCUS_DB = 38.0
MOST_LOST_DB = 0.5
LARGEST_DEPTH_ERROR = 0.03
LARGEST_CAMERA_ERROR = 0.01
LEAST_GAIN_DB = 3.0
OPAQUE = 0.9
LARGEST_SIDESTEP = 0.02
"""Of the width of the picture."""


@dataclass(frozen=True)
class Truth:
    """Picture and depth that a pinhole in the middle of the lens sees. all_in_focus: linear Rec.709; depth_m: along the optical axis."""

    all_in_focus: Float32[np.ndarray, "height width 3"]
    depth_m: Float32[np.ndarray, "height width"]


def read_truth(folder: Path) -> Truth:
    depth_m = read_exr(folder / "depth.exr")[0].stacked(["Z"])[..., 0]
    return Truth(read_image(folder / "all_in_focus.exr"), depth_m)


def true_cameras(data: Path) -> tuple[Camera, ...]:
    """The reference camera of every view, translations in metres; data: a folder that datasets_scripts.make_raw_stack wrote."""
    document = read_json(data / "truth.json", "the truth of a RAW stack")
    return tuple(camera_from_json(view["reference_camera"]) for view in document["views"])


def has_second_pass(stack: FocalStack) -> bool:
    return (stack.folder / FIRST_PASS_FOLDER / stack.depth_path.name).is_file()


def first_pass(stack: FocalStack) -> FocalStack:
    """The stack with the all-in-focus picture and depth that it had before `mrbokeh capture depth`."""
    return replace(stack, folder=stack.folder / FIRST_PASS_FOLDER) if has_second_pass(stack) else stack


@dataclass(frozen=True)
class Measurement:
    """Number of the report: its subject, its text, the wanted value, and whether that is met."""

    what: str
    text: str
    wanted: str
    met: bool


def merge_measurements(stack_folder: Path, truth_folder: Path) -> list[Measurement]:
    """Measure all-in-focus picture (linear, clipped to 1) and trusted depth against the pinhole truth, also of the first pass."""
    stack, truth = read_focal_stack(stack_folder), read_truth(truth_folder)
    passes = [first_pass(stack), stack] if has_second_pass(stack) else [stack]
    decibels = [psnr(each.all_in_focus(), truth.all_in_focus) for each in passes]
    depths = [depth_error(each, truth) for each in passes]
    sharpest_db = max(psnr(rgb, truth.all_in_focus) for rgb in stack.iter_rgb())
    earlier_db = "".join(f", from focus alone {each:.2f} dB" for each in decibels[:-1])
    earlier = "".join(f"; from focus alone {each.median:.2%} in {each.trusted:.0%}" for each in depths[:-1])
    return [
        Measurement(
            f"{stack.folder.name}: all-in-focus picture (the best single slice has {sharpest_db:.1f} dB{earlier_db})",
            f"{decibels[-1]:.2f} dB",
            f"at least {LEAST_ALL_IN_FOCUS_DB:g} dB" + (f", {MOST_LOST_DB:g} dB below focus alone at most" if decibels[1:] else ""),
            decibels[-1] >= max(LEAST_ALL_IN_FOCUS_DB, decibels[0] - MOST_LOST_DB),
        ),
        Measurement(
            f"{stack.folder.name}: depth, median relative error where it is trusted ({depths[-1].trusted:.0%} of the picture{earlier})",
            f"{depths[-1].median:.2%}",
            f"below {LARGEST_DEPTH_ERROR:.0%}",
            depths[-1].median < LARGEST_DEPTH_ERROR,
        ),
    ]


@dataclass(frozen=True)
class DepthError:
    """Error of depth. median: relative, of trusted depth. trusted: share of the picture."""

    median: float
    trusted: float


def depth_error(stack: FocalStack, truth: Truth) -> DepthError:
    trusted = stack.depth_confidence() >= TRUSTED
    error = np.abs(stack.depth_m() / truth.depth_m - 1.0)
    return DepthError(float(np.median(error[trusted])), float(trusted.mean()))


def camera_measurements(stacks: Sequence[FocalStack], true: Sequence[Camera]) -> list[Measurement]:
    """Scale and focal length of cameras that `mrbokeh capture poses` and `scale` put into the stacks, against the true ones."""
    found = [stack.camera for stack in stacks if stack.camera is not None]
    if len(found) != len(true) or spread_m(found) == 0.0:
        return [Measurement("camera poses in metres", "not found", "found", False)]
    scale = spread_m(found) / spread_m(true) - 1.0
    focal = max((mine.focal_px[0] / other.focal_px[0] - 1.0 for mine, other in zip(found, true, strict=True)), key=abs)
    numbers = {f"distances between the {len(found)} cameras": scale, "focal length of the cameras": focal}
    return [
        Measurement(f"{what}, relative error", f"{error:+.2%}", f"within {LARGEST_CAMERA_ERROR:.0%}", abs(error) <= LARGEST_CAMERA_ERROR)
        for what, error in numbers.items()
    ]


def spread_m(cameras: Sequence[Camera]) -> float:
    """Root of the mean squared distance of the camera centres from their mean: what a similarity of least squares scales by."""
    centres_m = np.array([camera.world_from_camera[:3, 3] for camera in cameras])
    return float(np.sqrt(((centres_m - centres_m.mean(axis=0)) ** 2).sum(axis=1).mean()))


def placement_measurement(layer: Path, at_pixel: str) -> Measurement:
    """Measure whether a virtual object stands upright over its pixel; its shadow is no more than half opaque."""
    alpha = read_layer(layer).alpha
    solid = np.nonzero(alpha > OPAQUE)[1]
    off_px = abs(float(solid.mean()) + 0.5 - float(at_pixel.split(",")[0])) if len(solid) else float("inf")
    allowed_px = LARGEST_SIDESTEP * alpha.shape[1]
    return Measurement(f"{layer.stem}: object beside its pixel", f"{off_px:.1f} px", f"at most {allowed_px:.0f} px", off_px <= allowed_px)


def parity_measurement(network: Path) -> Measurement:
    """ONNX Runtime against PyTorch, as `mrbokeh train export` measured it."""
    record = read_json(network.with_name(network.name + ".json"), "the record of an exported network")
    difference, allowed = float(record["parity_difference"]), float(record["largest_allowed"])
    what = f"{network.parent.name}: ONNX Runtime against PyTorch, largest difference of radiance"
    return Measurement(what, f"{difference:.1e}", f"below {allowed:.0e}", difference < allowed)


def network_measurements(evaluation_folder: Path) -> list[Measurement]:
    """The network on held-out slices against no blur and the better Gaussian, from evaluation.csv."""
    by_method: dict[str, list[float]] = defaultdict(list)
    with (evaluation_folder / "evaluation.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            by_method[row["method"]].append(float(row["psnr_db"]))
    mean = {method: float(np.mean(values)) for method, values in by_method.items()}
    rivals = {"no blur": mean["no blur"], "a Gaussian of the right size": max(mean["Gaussian, scattered"], mean["Gaussian, gathered"])}
    return [
        Measurement(
            f"network on {len(by_method['network'])} slices it has not seen ({mean['network']:.2f} dB) over {rival} ({decibel:.2f} dB)",
            f"{mean['network'] - decibel:+.2f} dB",
            f"at least +{LEAST_GAIN_DB:g} dB",
            mean["network"] - decibel >= LEAST_GAIN_DB,
        )
        for rival, decibel in rivals.items()
    ]


PACKAGES = ("numpy", "opencv-contrib-python-headless", "OpenEXR", "rawpy", "pycolmap", "torch", "onnxruntime", "embreex", "numba")

Plane = Float[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]
WORST = 0.1
"""Relative error of depth that is drawn brightest."""


def write_story(out: Path, done: Sequence[Done]) -> list[Measurement]:
    """Write report.html, numbers.json and previews into `out`; return the measurements."""
    measurements = _measurements(out / "desk", out / "board")
    sections = [*_desk_sections(out / "desk", out / "report.html"), _board_section(out / "board", out / "report.html")]
    write_json(out / "numbers.json", [vars(each) for each in measurements])
    write_report(out / "report.html", measurements, sections, done)
    return measurements


def write_quick_story(out: Path, done: Sequence[Done]) -> None:
    """Write quick.html into `out`: slices before and after an object was put in, the merged picture and its depth."""
    stack, page = read_focal_stack(out / "quick" / "scene" / BOARD_VIEWS[0]), out / "quick.html"
    blocks = []
    for each in BOARD:
        before = out / "pictures" / f"quick_before_{each.slice_index}.png"
        write_image(before, stack.slice_rgb(each.slice_index))
        blocks += [
            figure(before, page, f"the photograph: slice {each.slice_index} of {len(stack)}"),
            figure(out / "quick" / f"{each.name}_lens.png", page, "with a rendered alien, with the blur and the occlusion of this place"),
        ]
    merged = [figure(path, page, caption) for path, caption in write_stack_pictures(stack, out / "pictures")[-2:]]
    first = "A circuit board, photographed at seven focus distances. The alien stands on the same spot in two of the photographs."
    how = "What made it possible: the slices merged into one picture that is sharp everywhere, and its depth, found from focus."
    body = [
        "<h1>mrbokeh: a rendered object with the blur of the lens</h1>",
        section("Before and after", first, blocks),
        section("From the focus stack", how, merged),
        section("Stages", "Every stage is a command that you can run yourself.", [_stage_table(done)]),
    ]
    write_page(page, "mrbokeh demo --quick", body)


def write_report(path: Path, measurements: Sequence[Measurement], sections: Sequence[str], done: Sequence[Done]) -> None:
    """One page beside its pictures; sections are made by `section`."""
    total_s = sum(each.seconds for each in done)
    body = "\n".join(
        [
            "<h1>mrbokeh: from RAW photographs to a virtual object with the blur of their lens</h1>",
            f"<p>{len(done)} stages, {total_s:.0f} s in all when each last ran.</p>",
            section("Numbers", "Measured against the truth that the simulated photographs were made from.", [numbers_table(measurements)]),
            *sections,
            section("Stages", "Every stage is a command that you can run yourself.", [_stage_table(done)]),
            section("Versions", "", [_versions()]),
        ]
    )
    write_page(path, "mrbokeh demo", [body])


def figure(picture: Path, page: Path, caption: str) -> str:
    """A picture by its path relative to the page, so that the folder can be moved."""
    source = html.escape(os.path.relpath(picture, page.parent))
    return f'<figure><img src="{source}" alt="{html.escape(caption)}"><figcaption>{html.escape(caption)}</figcaption></figure>'


def link(target: Path, page: Path, text: str) -> str:
    """A paragraph that leads to another page, by its relative path."""
    return f'<p><a href="{html.escape(os.path.relpath(target, page.parent))}">{html.escape(text)}</a></p>'


def numbers_table(measurements: Sequence[Measurement]) -> str:
    rows = [(cell(each.what), cell(each.text, "number"), cell(each.wanted, "met" if each.met else "missed")) for each in measurements]
    return table(("what", "measured", "wanted"), rows)


def _stage_table(done: Sequence[Done]) -> str:
    rows = [
        (
            cell(each.stage.purpose),
            cell("failed", "missed") if each.failed else cell(f"{each.seconds:.1f} s", "number"),
            f"<td><code>{html.escape(each.stage.command_line)}</code></td>",
        )
        for each in done
    ]
    return table(("stage", "time", "command"), rows)


def _versions() -> str:
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    numbers = [("mrbokeh", __version__), ("Python", platform.python_version()), *((name, _version(name)) for name in PACKAGES)]
    return table(("what", "version"), [(cell(name), cell(number)) for name, number in (*numbers, ("machine", machine))])


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def write_depth_pictures(stack: FocalStack, truth: Truth, out: Path) -> list[tuple[Path, str]]:
    """Return (file, caption) of pictures of depth before and after `mrbokeh capture depth`; [] if there was no second pass."""
    if not has_second_pass(stack):
        return []
    passes = {"from focus alone": first_pass(stack), "from focus and all viewpoints": stack}
    pictures = {name: _views(each, name, truth) for name, each in passes.items()}
    written = []
    for kind in ("depth", "confidence", "error"):
        for number, name in enumerate(passes, 1):
            rgb, caption = pictures[name][kind]
            path = out / f"{stack.folder.name}_pass_{number}_{kind}.png"
            write_preview(path, rgb)
            written.append((path, caption))
    return written


def _views(stack: FocalStack, name: str, truth: Truth) -> dict[str, tuple[Rgb, str]]:
    """Return (picture, caption) of each kind."""
    error = np.abs(stack.depth_m() / truth.depth_m - 1.0)
    return {
        "depth": (depth_picture(stack), f"depth {name}; grey where it is a guess"),
        "confidence": (_grey(stack.depth_confidence()), f"confidence of the depth {name}: white is 1"),
        "error": (_colours(error / WORST), f"error of the depth {name}: black is none, bright yellow {WORST:.0%} or more"),
    }


def _grey(level: Plane) -> Rgb:
    return srgb_to_linear(np.repeat(np.clip(level, 0.0, 1.0)[..., None], 3, axis=2).astype(np.float32))


def _colours(level: Plane) -> Rgb:
    steps = np.round(255.0 * np.clip(level, 0.0, 1.0)).astype(np.uint8)
    return srgb_to_linear(cv2.applyColorMap(steps, cv2.COLORMAP_INFERNO)[..., ::-1] / np.float32(255.0))


def _measurements(desk: Path, board: Path) -> list[Measurement]:
    truth = DATA / "raw_stack"
    return [
        *(each for view in VIEWS for each in merge_measurements(desk / "scene" / view, truth / "truth" / view)),
        *camera_measurements([read_focal_stack(desk / "scene" / view) for view in VIEWS], true_cameras(truth)),
        *network_measurements(desk / "evaluation"),
        *(
            placement_measurement(folder / f"{each.name}_network.exr", each.at_pixel)
            for folder, placements in ((desk, DESK), (board, BOARD))
            for each in placements
        ),
        parity_measurement(desk / "lens.onnx"),
        parity_measurement(board / "lens.onnx"),
    ]


def _desk_sections(desk: Path, page: Path) -> list[str]:
    stack = desk / "scene" / HELD_OUT_VIEW
    return [
        section(
            "1. Capture: RAW files to a registered stack, an all-in-focus picture and depth",
            "The desk was ray-traced through a thin lens with a stop in its middle, as mirror lenses have, and written as noisy Bayer DNG.",
            [*_stack_figures(stack, page), _link_to_capture_report(desk, page)],
        ),
        section(
            "2. Capture from several viewpoints: camera poses, their scale, depth",
            "Poses come from the all-in-focus pictures (COLMAP), metres from the focus distances; then neighbouring viewpoints and focus "
            "give depth together, and the all-in-focus picture is made again with it.",
            _depth_figures(stack, page),
        ),
        section(
            "3. Train: a network learns the lens",
            "Trained on two viewpoints; these slices are of a third, which it has not seen.",
            [figure(desk / "evaluation" / "evaluation.png", page, "input, truth, network, Gaussian, no blur, difference")],
        ),
        section(
            "4. Composite: a virtual object in a slice",
            "The same object, blurred by the ONNX network and by the reference renderer.",
            _composite_figures(desk, DESK, page),
        ),
    ]


def _board_section(board: Path, page: Path) -> str:
    return section(
        "5. The same with photographs",
        "A circuit board, photographed with a macro camera from one viewpoint, so that depth comes from focus alone; its optics are "
        "estimated from the photographs (lens.toml).",
        [
            *_stack_figures(board / "scene" / "pcb_oblique", page),
            _link_to_capture_report(board, page),
            *_composite_figures(board, BOARD, page),
        ],
    )


def _link_to_capture_report(folder: Path, page: Path) -> str:
    return link(folder / "scene" / "report.html", page, "The capture report of this scene: what proves or disproves its stacks")


def _depth_figures(stack: Path, page: Path) -> list[str]:
    truth = read_truth(DATA / "raw_stack" / "truth" / stack.name)
    pictures = write_depth_pictures(read_focal_stack(stack), truth, page.parent / "pictures")
    if not pictures:
        return ["<p>Camera poses were not found: see the messages of the stages.</p>"]
    return [figure(path, page, caption) for path, caption in pictures]


def _stack_figures(stack: Path, page: Path) -> list[str]:
    """Return figures of a stack, without depth if a second pass found it, which has figures of its own."""
    read = read_focal_stack(stack)
    pictures = write_stack_pictures(read, page.parent / "pictures")
    return [figure(path, page, caption) for path, caption in (pictures[:-1] if has_second_pass(read) else pictures)]


def _composite_figures(folder: Path, placements: tuple[Placement, ...], page: Path) -> list[str]:
    return [
        figure(folder / f"{each.name}_{renderer}.png", page, f"slice {each.slice_index}, blurred by the {renderer}")
        for each in placements
        for renderer in ("network", "reference")
    ]
