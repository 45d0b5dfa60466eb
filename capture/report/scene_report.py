"""`mrbokeh capture report`: report.html and report.json of a scene, and which of its gates make `--strict` fail."""

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capture.poses.sparse_model import SparseModel, SparseView
from capture.report import HTML_NAME
from capture.report.examination import Examination, examine
from capture.report.exclusion import exclusion_masks, has_fresh_exclusions, write_exclusions
from capture.report.findings import StackFindings, pair_document, picture_document, slice_document
from capture.report.gates import (
    PICTURE_RULES,
    STACK_RULES,
    Gate,
    Verdict,
    absent,
    absent_names,
    by_use,
    counts,
    failed,
    finite,
    verdict_line,
)
from capture.report.pictures import Shown, ShownPlace, shown_places, slice_triple, stack_maps, worst_places
from capture.report.report_cache import read_cache, signature_of, write_cache
from capture.report.stack_gates import SCENE_RULES, WHERE, Reconstruction, merged_gate, read_reconstruction, scene_gates, stack_gates
from capture.report.stack_section import ExaminedStack, gate_table, stack_section
from capture.report.stack_view import DEFAULT_WIDTH_PX, Reblur, StackView
from mrbokeh import __version__
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.errors import InputError
from mrbokeh.system.html_page import cell, section, table, write_page

MOST_POINTS = 4000
_CORNERS = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
_SCRIPT = """
(() => {
  const data = JSON.parse(document.getElementById('poses-data').textContent), canvas = document.getElementById('poses');
  const context = canvas.getContext('2d'), fingers = new Map();
  let yaw = 0.5, pitch = -0.35, zoom = 1, pinch = 0;
  const turned = ([x, y, z]) => {
    const a = Math.cos(yaw) * x + Math.sin(yaw) * z, b = -Math.sin(yaw) * x + Math.cos(yaw) * z;
    return [a, Math.cos(pitch) * y - Math.sin(pitch) * b, Math.sin(pitch) * y + Math.cos(pitch) * b];
  };
  const onScreen = p => {
    const [x, y, z] = turned(p), scale = 0.36 * canvas.height * zoom * 3 / (3 + z);
    return [canvas.width / 2 + x * scale, canvas.height / 2 + y * scale, z];
  };
  const scaled = p => p.map(v => v / data.reach);
  const line = (a, b) => { context.beginPath(); context.moveTo(a[0], a[1]); context.lineTo(b[0], b[1]); context.stroke(); };
  function draw() {
    context.clearRect(0, 0, canvas.width, canvas.height);
    for (let i = 0; i < data.points.length; i += 3) {
      const [x, y, z] = onScreen(data.points.slice(i, i + 3)), light = Math.round(190 - 50 * Math.max(-1, Math.min(1, z)));
      context.fillStyle = `rgb(${light},${light},${light})`; context.fillRect(x, y, 1.5, 1.5);
    }
    context.strokeStyle = '#ffb347'; context.fillStyle = '#ffd9a0'; context.font = '13px system-ui, sans-serif';
    for (const camera of data.cameras) {
      const centre = onScreen(scaled(camera.centre)), corners = camera.corners.map(c => onScreen(scaled(c)));
      corners.forEach((corner, i) => { line(centre, corner); line(corner, corners[(i + 1) % 4]); });
      context.fillText(camera.name, centre[0] + 5, centre[1] - 5);
    }
    const length = 10 ** Math.floor(Math.log10(data.reach)), pixels = 0.36 * canvas.height * zoom * length / data.reach;
    context.strokeStyle = context.fillStyle = '#8fd3ff'; line([20, canvas.height - 20], [20 + pixels, canvas.height - 20]);
    context.fillText(`${+length.toPrecision(3)} ${data.unit}`, 20, canvas.height - 28);
  }
  canvas.addEventListener('pointerdown', e => {
    canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); pinch = 0;
  });
  canvas.addEventListener('pointermove', e => {
    if (!fingers.has(e.pointerId)) return;
    const [x, y] = fingers.get(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (fingers.size === 1) {
      yaw += (e.clientX - x) * 0.008; pitch = Math.max(-1.6, Math.min(1.6, pitch - (e.clientY - y) * 0.008));
    } else {
      const [a, b] = [...fingers.values()], apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (pinch) zoom *= apart / pinch;
      pinch = apart;
    }
    draw();
  });
  for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, e => { fingers.delete(e.pointerId); pinch = 0; });
  canvas.addEventListener('wheel', e => { e.preventDefault(); zoom *= Math.exp(-e.deltaY * 0.001); draw(); }, { passive: false });
  canvas.addEventListener('dblclick', () => { yaw = 0.5; pitch = -0.35; zoom = 1; draw(); });
  draw();
})();
"""
MOST_WITH_PICTURES = 12
_STYLE = """
details { margin: 1rem 0; border-top: 1px solid #ddd; padding-top: .6rem; } summary { cursor: pointer; padding: .3rem 0; }
.gates td { border-bottom: 1px solid #eee; } .charts { margin: 1rem 0; }
.place { display: inline-block; vertical-align: top; margin: .4rem 1.6rem .4rem 0; } .place p { margin: 0; font-size: 14px; }
.place figure { width: 160px; vertical-align: top; margin: .3rem .5rem .3rem 0; } .place figcaption { line-height: 1.3; }
.place img { max-width: none; border: 0; display: block; }
@media (max-width: 640px) {
  .gates tr:first-child { display: none; } .gates tr { display: block; padding: .5rem 0; border-bottom: 1px solid #ccc; }
  .gates td { display: block; border: 0; padding: 0; } .gates td.name { font-weight: bold; }
  .place { display: block; margin-right: 0; }
  .gates td.wanted::before { content: "wanted: "; } .gates td.why { color: #667; font-size: 13px; }
}
"""
JSON_NAME = "report.json"
FORMAT, VERSION = "mrbokeh-capture-report", 2
GATE_NAMES = tuple(each.name for each in (*SCENE_RULES, *STACK_RULES))


@dataclass(frozen=True)
class SceneReport:
    """Report of a scene."""

    scene: Path
    gates: tuple[Gate, ...]
    stacks: tuple[ExaminedStack, ...]
    reconstruction: Reconstruction = field(repr=False)

    @property
    def failures(self) -> list[Gate]:
        return failed(self.gates)

    @property
    def absences(self) -> list[Gate]:
        return absent(self.gates)

    @property
    def passed(self) -> bool:
        """Return whether no gate failed, and those that look at the all-in-focus picture were judged, in every stack."""
        looked_at = all(
            any(gate.name == rule.name and gate.verdict is Verdict.PASSED for gate in each.gates)
            for each in self.stacks
            for rule in PICTURE_RULES
        )
        return bool(self.stacks) and looked_at and not self.failures


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
    """Return findings, gates and pictures of a merged stack, found now or before; its exclusion.exr is made fresh."""
    signature = signature_of(stack, reblur, widest_px)
    found = None if overwrite else read_cache(stack, signature)
    reused = found is not None
    if found is None:
        view = StackView(stack, widest_px)
        examination, pictures = _examine(view, reblur)
        write_exclusions(stack, exclusion_masks(stack, examination.moving))
        found = write_cache(stack, signature, examination, pictures, _places(view, examination))
    elif not has_fresh_exclusions(stack):
        write_exclusions(stack, exclusion_masks(stack, found.moving()))
    return ExaminedStack(
        findings=found.findings, gates=stack_gates(found.findings), pictures=found.pictures, places=found.places, reused=reused
    )


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
    """Return the nearest, a middle, the farthest and the worst one."""
    count = len(findings.slices)
    known = [each for each in findings.slices if each.psnr_db is not None]
    worst = [min(known, key=lambda each: each.psnr_db or 0.0).index] if known else []
    return sorted({0, count // 2, count - 1, *worst})


def require_gates(allow_absent: Sequence[str], strict: bool) -> tuple[str, ...]:
    """Return the names of gates as the report writes them. Raises InputError for a name that is none, and if nothing is strict."""
    if allow_absent and not strict:
        raise InputError(
            "--allow-absent says which gates --strict may leave unjudged, but --strict is not given: add it, or leave both out"
        )
    known = {name.casefold(): name for name in GATE_NAMES}
    for name in allow_absent:
        if name.strip().casefold() not in known:
            listed = ", ".join(f'"{each}"' for each in GATE_NAMES)
            raise InputError(f'--allow-absent "{name}": expected the name of a gate as the report shows it: {listed}')
    return tuple(known[name.strip().casefold()] for name in allow_absent)


def unmet(report: SceneReport, allowed: Sequence[str]) -> list[Gate]:
    """Return gates that failed, and those that could not be judged although nobody allowed that."""
    return [*report.failures, *(each for each in report.absences if each.name not in allowed)]


def report_document(report: SceneReport) -> dict[str, Any]:
    """Return what machines read: every gate, and the numbers of every slice."""
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


def write_html(report: SceneReport) -> None:
    """Write one file in the folder of the scene, with all pictures inside."""
    failures = report.failures
    unseen = "" if failures or report.passed else " Not passed: not all gates of the all-in-focus pictures could be judged."
    blocks = [
        f"<h1>Capture report: {report.scene.resolve().name}</h1>",
        *(f'<p class="{_kind(gates)}">{html.escape(verdict_line(use, gates))}.</p>' for use, gates in by_use(report.gates).items()),
        f'<p class="muted">{counts(report.gates)}.{unseen}</p>',
        f'<p class="muted">Absent: {html.escape(absent_names(report.gates))}.</p>' if report.absences else "",
        f'<p class="muted">Merged stacks: {len(report.stacks)}. mrbokeh {__version__}.</p>',
        section("What failed", "The sections below have all gates.", [gate_table(failures, with_place=True)]) if failures else "",
        *_scene_sections(report),
        section("Stacks", "", _stack_sections(report.stacks)),
    ]
    write_page(report.scene / HTML_NAME, f"Capture report: {report.scene.resolve().name}", blocks, _STYLE)


def _kind(gates: Sequence[Gate]) -> str:
    """Return the class of a verdict: each use of the stacks has its own."""
    return "missed" if failed(gates) else "muted" if absent(gates) else "met"


def _scene_sections(report: SceneReport) -> list[str]:
    whole = [each for each in report.gates if each.where == WHERE]
    sections = [section("Scene", "", [gate_table(whole)])]
    model, scales = report.reconstruction.model, report.reconstruction.scales
    if model is not None:
        sections.append(section("Cameras", f"{len(model.views)} viewpoints, {len(model.points)} points.", [poses_view(model)]))
    if scales:
        rows = [(cell(method), cell(f"{metres:.6g}", "number")) for method, metres in scales.items()]
        sections.append(section("Scale", "Every method's answer.", [table(("method", "metres per unit"), rows)]))
    return sections


def _stack_sections(stacks: Sequence[ExaminedStack]) -> list[str]:
    """Return sections, most failures first; pictures for the first dozen, so that the page stays one that can be opened."""
    ranked = sorted(stacks, key=lambda each: (-each.failures, each.findings.name))
    return [stack_section(each, with_pictures=rank < MOST_WITH_PICTURES) for rank, each in enumerate(ranked)]


def poses_view(model: SparseModel) -> str:
    """Return HTML of cameras and points in 3D: a canvas that is turned by mouse or finger, without any library.

    Lengths are in metres where the scale is known, else in the model's unit.
    """
    data = json.dumps(scene_of(model), separators=(",", ":")).replace("</", "<\\/")
    return (
        f'<canvas id="poses" width="900" height="520" style="touch-action:none;background:#14171c;border-radius:6px"></canvas>'
        f'<p class="muted">Drag to turn, wheel or two fingers to zoom, double click to start over.</p>'
        f'<script type="application/json" id="poses-data">{data}</script><script>{_SCRIPT}</script>'
    )


def scene_of(model: SparseModel) -> dict[str, Any]:
    """Return what the canvas draws, about the median point: cameras as a centre and four corners of the picture, and some of the points."""
    model = model.scaled() if model.metres_per_unit is not None else model
    centres = np.array([each.centre for each in model.views]).reshape(-1, 3)
    points = (
        model.points[np.linspace(0, len(model.points) - 1, min(len(model.points), MOST_POINTS)).astype(int)]
        if len(model.points)
        else model.points
    )
    everything = np.concatenate([centres, points])
    middle = np.median(everything, axis=0) if len(everything) else np.zeros(3)
    reach = float(np.percentile(np.linalg.norm(everything - middle, axis=1), 90)) if len(everything) else 1.0
    size = 0.12 * max(reach, 1e-9)
    return {
        "unit": "m" if model.metres_per_unit is not None else "units",
        "reach": max(reach, 1e-9),
        "cameras": [_camera(each, middle, size) for each in model.views],
        "points": np.round((points - middle) / max(reach, 1e-9), 4).ravel().tolist(),
    }


def _camera(view: SparseView, middle: np.ndarray, size: float) -> dict[str, Any]:
    camera = view.camera
    corners_px = np.array(_CORNERS) * [camera.width_px, camera.height_px]
    corners = camera.unproject(corners_px, np.full(4, size))
    return {"name": view.name, "centre": (view.centre - middle).tolist(), "corners": (corners - middle).tolist()}
