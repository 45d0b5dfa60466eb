"""Report of the demo: report.html with measurements against truth, pictures of every stage, times and versions."""

import html
import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh import __version__
from mrbokeh.demo.measurements import (
    Measurement,
    Truth,
    camera_measurements,
    first_pass,
    has_second_pass,
    merge_measurements,
    network_measurements,
    parity_measurement,
    placement_measurement,
    read_truth,
    true_cameras,
)
from mrbokeh.demo.plan import BOARD, DATA, DESK, HELD_OUT_VIEW, VIEWS, Placement
from mrbokeh.demo.stages import Done
from mrbokeh.figures.stack_pictures import depth_picture, write_stack_pictures
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.image_io import write_preview
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.html_page import cell, section, table, write_page

PACKAGES = ("numpy", "opencv-python-headless", "OpenEXR", "rawpy", "pycolmap", "torch", "onnxruntime", "embreex", "numba")

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
