"""Puts the results of the demo together: measurements, pictures, report.html."""

from collections.abc import Sequence
from pathlib import Path

from mrbokeh.atomic_files import write_json
from mrbokeh.demo.measurements import Measurement, merge_measurements, network_measurements, parity_measurement
from mrbokeh.demo.plan import BOARD, DATA, DESK, HELD_OUT_VIEW, VIEWS, Placement
from mrbokeh.demo.report import figure, write_report
from mrbokeh.demo.stages import Done
from mrbokeh.focal_stack import read_focal_stack
from mrbokeh.html_page import section
from mrbokeh.stack_pictures import write_stack_pictures


def write_story(out: Path, done: Sequence[Done]) -> list[Measurement]:
    """report.html, numbers.json and previews in `out`; returns the measurements."""
    desk, board, page = out / "desk", out / "board", out / "report.html"
    measurements = [
        *(each for view in VIEWS for each in merge_measurements(desk / "scene" / view, DATA / "raw_stack" / "truth" / view)),
        *network_measurements(desk / "evaluation"),
        parity_measurement(desk / "lens.onnx"),
        parity_measurement(board / "lens.onnx"),
    ]
    sections = [
        section(
            "1. Capture: RAW files to a registered stack, an all-in-focus picture and depth",
            "The desk was ray-traced through a thin lens with a stop in its middle, as mirror lenses have, and written as noisy Bayer DNG.",
            _stack_figures(desk / "scene" / HELD_OUT_VIEW, page),
        ),
        section(
            "2. Train: a network learns the lens",
            "Trained on two viewpoints; these slices are of a third, which it has not seen.",
            [figure(desk / "evaluation" / "evaluation.png", page, "input, truth, network, Gaussian, no blur, difference")],
        ),
        section(
            "3. Composite: a virtual object in a slice",
            "The same object, blurred by the ONNX network and by the reference renderer.",
            _composite_figures(desk, DESK, page),
        ),
        section(
            "4. The same with photographs",
            "A circuit board, photographed with a macro camera; its optics are estimated from the photographs (lens.toml).",
            [*_stack_figures(board / "scene" / "pcb_oblique", page), *_composite_figures(board, BOARD, page)],
        ),
    ]
    write_json(out / "numbers.json", [vars(each) for each in measurements])
    write_report(page, measurements, sections, done)
    return measurements


def _stack_figures(stack: Path, page: Path) -> list[str]:
    pictures = write_stack_pictures(read_focal_stack(stack), page.parent / "pictures")
    return [figure(path, page, caption) for path, caption in pictures]


def _composite_figures(folder: Path, placements: tuple[Placement, ...], page: Path) -> list[str]:
    return [
        figure(folder / f"{each.name}_{renderer}.png", page, f"slice {each.slice_index}, blurred by the {renderer}")
        for each in placements
        for renderer in ("network", "reference")
    ]
