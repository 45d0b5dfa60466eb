"""`report.html`: the whole report as one page."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from capture.report.gates import Gate, failed
from capture.report.poses_view import poses_view
from capture.report.scene_gates import WHERE, Reconstruction
from capture.report.stack_section import ExaminedStack, gate_table, stack_section
from mrbokeh import __version__
from mrbokeh.html_page import cell, section, table, write_page

HTML_NAME = "report.html"
MOST_WITH_PICTURES = 12
_STYLE = """
details { margin: 1rem 0; border-top: 1px solid #ddd; padding-top: .6rem; } summary { cursor: pointer; padding: .3rem 0; }
.gates td { border-bottom: 1px solid #eee; } .charts { margin: 1rem 0; }
@media (max-width: 640px) {
  .gates tr:first-child { display: none; } .gates tr { display: block; padding: .5rem 0; border-bottom: 1px solid #ccc; }
  .gates td { display: block; border: 0; padding: 0; } .gates td.name { font-weight: bold; }
  .gates td.wanted::before { content: "wanted: "; } .gates td.why { color: #667; font-size: 13px; }
}
"""


@dataclass(frozen=True)
class SceneReport:
    scene: Path
    gates: tuple[Gate, ...]
    stacks: tuple[ExaminedStack, ...]
    reconstruction: Reconstruction = field(repr=False)

    @property
    def failures(self) -> list[Gate]:
        return failed(self.gates)


def write_html(report: SceneReport) -> None:
    """One file in the folder of the scene, with all pictures inside."""
    failures = report.failures
    verdict = f"{len(failures)} of {len(report.gates)} gates failed" if failures else f"no gate failed of {len(report.gates)}"
    kind = "missed" if failures else "met"
    blocks = [
        f"<h1>Capture report: {report.scene.resolve().name}</h1>",
        f'<p class="{kind}">{verdict}.</p><p class="muted">{len(report.stacks)} merged stacks, mrbokeh {__version__}.</p>',
        section("What failed", "The sections below have all gates.", [gate_table(failures, with_place=True)]) if failures else "",
        *_scene_sections(report),
        section("Stacks", "", _stack_sections(report.stacks)),
    ]
    write_page(report.scene / HTML_NAME, f"Capture report: {report.scene.resolve().name}", blocks, _STYLE)


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
    """Those with most failures first; pictures for the first dozen, so that the page stays one that can be opened."""
    ranked = sorted(stacks, key=lambda each: (-each.failures, each.findings.name))
    return [stack_section(each, with_pictures=rank < MOST_WITH_PICTURES) for rank, each in enumerate(ranked)]
