"""Puts the results of the demo together: measurements, pictures, report.html."""

from collections.abc import Sequence
from pathlib import Path

from mrbokeh.demo.measurements import (
    Measurement,
    camera_measurements,
    merge_measurements,
    network_measurements,
    parity_measurement,
    placement_measurement,
)
from mrbokeh.demo.pictures import write_depth_pictures
from mrbokeh.demo.plan import BOARD, DATA, DESK, HELD_OUT_VIEW, VIEWS, Placement
from mrbokeh.demo.report import figure, link, write_report
from mrbokeh.demo.stages import Done
from mrbokeh.demo.truth import has_second_pass, read_truth, true_cameras
from mrbokeh.figures.stack_pictures import write_stack_pictures
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.html_page import section


def write_story(out: Path, done: Sequence[Done]) -> list[Measurement]:
    """report.html, numbers.json and previews in `out`; returns the measurements."""
    measurements = _measurements(out / "desk", out / "board")
    sections = [*_desk_sections(out / "desk", out / "report.html"), _board_section(out / "board", out / "report.html")]
    write_json(out / "numbers.json", [vars(each) for each in measurements])
    write_report(out / "report.html", measurements, sections, done)
    return measurements


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
    """Without the depth where a second pass found it, for that has figures of its own."""
    read = read_focal_stack(stack)
    pictures = write_stack_pictures(read, page.parent / "pictures")
    return [figure(path, page, caption) for path, caption in (pictures[:-1] if has_second_pass(read) else pictures)]


def _composite_figures(folder: Path, placements: tuple[Placement, ...], page: Path) -> list[str]:
    return [
        figure(folder / f"{each.name}_{renderer}.png", page, f"slice {each.slice_index}, blurred by the {renderer}")
        for each in placements
        for renderer in ("network", "reference")
    ]
