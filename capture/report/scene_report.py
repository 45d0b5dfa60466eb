"""`report.html` and `report.json` of a scene."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from capture.report.examination import StackFindings, examine
from capture.report.exclusion_masks import exclusion_masks, write_exclusions
from capture.report.gates import Gate, Rule
from capture.report.pictures import Shown, slice_triple, stack_maps
from capture.report.reblur import Reblur
from capture.report.scene_gates import WHERE, read_reconstruction, scene_gates
from capture.report.scene_page import SceneReport, write_html
from capture.report.stack_gates import stack_gates
from capture.report.stack_section import ExaminedStack
from capture.report.stack_view import DEFAULT_WIDTH_PX, StackView
from mrbokeh import __version__
from mrbokeh.atomic_files import write_json
from mrbokeh.focal_stack import FocalStack, find_focal_stacks

JSON_NAME = "report.json"
FORMAT, VERSION = "mrbokeh-capture-report", 1

MERGED = Rule(
    "all stacks merged",
    "all-in-focus picture and depth of every stack",
    "Nothing else can be judged before.",
    "Run `mrbokeh capture merge` on the scene.",
)


def report_scene(scene: Path, reblur: Reblur | None = None, widest_px: int = DEFAULT_WIDTH_PX) -> SceneReport:
    """Examine every merged stack; writes report.html, report.json and each stack's exclusion.exr. Stacks not merged fail a gate."""
    stacks = find_focal_stacks(scene)
    reconstruction = read_reconstruction(scene)
    examined = [examine_stack(stack, reblur or Reblur(), widest_px) for stack in stacks if stack.merged]
    gates = (merged_gate(stacks), *scene_gates(reconstruction), *(gate for each in examined for gate in each.gates))
    report = SceneReport(scene, gates, tuple(examined), reconstruction)
    write_json(scene / JSON_NAME, report_document(report))
    write_html(report)
    return report


def merged_gate(stacks: Sequence[FocalStack]) -> Gate:
    waiting = [stack.folder.name for stack in stacks if not stack.merged]
    named = f" (waiting: {', '.join(waiting)})" if waiting else ""
    return MERGED.judge(WHERE, float(len(waiting)), f"{len(stacks) - len(waiting)} of {len(stacks)}{named}", not waiting)


def examine_stack(stack: FocalStack, reblur: Reblur, widest_px: int) -> ExaminedStack:
    """Findings, gates and pictures of a merged stack; writes its exclusion.exr."""
    view = StackView(stack, widest_px)
    triples: dict[int, list[Shown]] = {}

    def keep(index: int, rgb: Any, prediction: Any) -> None:
        triples[index] = slice_triple(index, rgb, prediction)

    findings = examine(view, reblur, keep)
    write_exclusions(stack, exclusion_masks(stack, findings.moving))
    depth_off_px = None if findings.depth is None else findings.depth.off_px
    pictures = [picture for index in shown_slices(findings) for picture in triples.get(index, [])]
    return ExaminedStack(findings, stack_gates(findings), stack_maps(view, findings.moving, depth_off_px), pictures)


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
        "passed": not report.failures,
        "gates": [each.as_json() for each in report.gates],
        "scales_metres_per_unit": report.reconstruction.scales,
        "stacks": {each.findings.name: _stack_document(each.findings) for each in report.stacks},
    }


def _stack_document(findings: StackFindings) -> dict[str, Any]:
    drift, curve = findings.drift, findings.curve
    return {
        "examined_width_px": findings.width_px,
        "moving_share": None if findings.moving is None else float(findings.moving.mean()),
        "sharp_shares": None if curve is None else curve.shares.tolist(),
        "registration_shift_px": None if drift is None else drift.shift_px.tolist(),
        "registration_magnification": None if drift is None else drift.magnification.tolist(),
        "slices": [
            {
                "index": each.index,
                "gain": _finite(each.gain),
                "saturated_share": each.saturated,
                "counted_share": each.counted,
                "largest_coc_px": each.largest_coc_px,
                "psnr_db": _finite(each.psnr_db),
                "unblurred_psnr_db": _finite(each.unblurred_db),
                "changes": None
                if each.fit is None
                else {name: {"value": _finite(change.value), "error": _finite(change.error)} for name, change in each.fit.changes.items()},
            }
            for each in findings.slices
        ],
    }


def _finite(value: float | None) -> float | None:
    """JSON has neither nan nor infinity."""
    return value if value is not None and abs(value) < float("inf") else None
