"""`report.html` and `report.json` of a scene."""

from pathlib import Path
from typing import Any

from capture.report.examination import Examination, examine
from capture.report.exclusion_masks import exclusion_masks, has_fresh_exclusions, write_exclusions
from capture.report.findings import StackFindings
from capture.report.findings_json import pair_document, picture_document, slice_document
from capture.report.json_numbers import finite
from capture.report.kept_examination import keep, kept, signature_of
from capture.report.pictures import Shown, slice_triple, stack_maps
from capture.report.reblur import Reblur
from capture.report.scene_gates import merged_gate, read_reconstruction, scene_gates
from capture.report.scene_page import SceneReport, write_html
from capture.report.stack_gates import stack_gates
from capture.report.stack_section import ExaminedStack
from capture.report.stack_view import DEFAULT_WIDTH_PX, StackView
from capture.report.worst_places import ShownPlace, shown_places, worst_places
from mrbokeh import __version__
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks
from mrbokeh.system.atomic_files import write_json

JSON_NAME = "report.json"
FORMAT, VERSION = "mrbokeh-capture-report", 2


def report_scene(scene: Path, reblur: Reblur | None = None, widest_px: int = DEFAULT_WIDTH_PX, *, overwrite: bool = False) -> SceneReport:
    """Examine every merged stack; writes report.html, report.json and each stack's exclusion.exr. Stacks not merged fail a gate.

    What was found of a stack is kept in its folder and used again while nothing changed that it depends on, unless overwrite is set.
    """
    stacks = find_focal_stacks(scene)
    reconstruction = read_reconstruction(scene)
    examined = [examine_stack(stack, reblur or Reblur(), widest_px, overwrite=overwrite) for stack in stacks if stack.merged]
    gates = (merged_gate(stacks), *scene_gates(reconstruction), *(gate for each in examined for gate in each.gates))
    report = SceneReport(scene, gates, tuple(examined), reconstruction)
    write_json(scene / JSON_NAME, report_document(report))
    write_html(report)
    return report


def examine_stack(stack: FocalStack, reblur: Reblur, widest_px: int, *, overwrite: bool = False) -> ExaminedStack:
    """Findings, gates and pictures of a merged stack, found now or before; sees to it that its exclusion.exr is fresh."""
    signature = signature_of(stack, reblur, widest_px)
    found = None if overwrite else kept(stack, signature)
    reused = found is not None
    if found is None:
        view = StackView(stack, widest_px)
        examination, pictures = _examine(view, reblur)
        write_exclusions(stack, exclusion_masks(stack, examination.moving))
        found = keep(stack, signature, examination, pictures, _places(view, examination))
    elif not has_fresh_exclusions(stack):
        write_exclusions(stack, exclusion_masks(stack, found.moving()))
    return ExaminedStack(found.findings, stack_gates(found.findings), found.pictures, found.places, reused)


def _places(view: StackView, examination: Examination) -> list[ShownPlace]:
    look = examination.look
    return shown_places(view.stack, look.picture, worst_places(look, view.stack.focus_index(), examination.findings.pairs))


def _examine(view: StackView, reblur: Reblur) -> tuple[Examination, list[Shown]]:
    """Examine a stack, and keep pictures of it as a whole, then three each of some slices."""
    triples: dict[int, list[Shown]] = {}

    def watch(index: int, rgb: Any, prediction: Any) -> None:
        triples[index] = slice_triple(index, rgb, prediction)

    examination = examine(view, reblur, watch)
    depth_off_px = None if examination.depth is None else examination.depth.off_px
    of_slices = [picture for index in shown_slices(examination.findings) for picture in triples.get(index, [])]
    return examination, [*stack_maps(view, examination.moving, depth_off_px), *of_slices]


def shown_slices(findings: StackFindings) -> list[int]:
    """The nearest, a middle, the farthest and the worst one."""
    count = len(findings.slices)
    known = [each for each in findings.slices if each.psnr_db is not None]
    worst = [min(known, key=lambda each: each.psnr_db or 0.0).index] if known else []
    return sorted({0, count // 2, count - 1, *worst})


def report_document(report: SceneReport) -> dict[str, Any]:
    """What machines read: every gate, and the numbers of every slice."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "made_by": f"mrbokeh {__version__}",
        "passed": report.passed,
        "judged": len(report.gates) - len(report.absences),
        "failed": len(report.failures),
        "absent": len(report.absences),
        "gates": [each.as_json() for each in report.gates],
        "scales_metres_per_unit": report.reconstruction.scales,
        "stacks": {each.findings.name: _stack_document(each) for each in report.stacks},
    }


def _stack_document(examined: ExaminedStack) -> dict[str, Any]:
    findings, drift = examined.findings, examined.findings.drift
    return {
        "examined_width_px": findings.size_px[0],
        "moving_share": findings.moving_share,
        "sharp_shares": findings.curve.shares.tolist(),
        "registration_shift_px": None if drift is None else drift.shift_px.tolist(),
        "registration_magnification": None if drift is None else drift.magnification.tolist(),
        "registration_residuals_px": None if drift is None else list(drift.residuals_px),
        "picture": picture_document(findings.picture, finite),
        "neighbours": [pair_document(each, finite) for each in findings.pairs],
        "worst_places": [{"gate": each.gate, "at_px": list(each.at_px), "what": each.caption} for each in examined.places],
        "slices": [slice_document(each, finite) for each in findings.slices],
    }
