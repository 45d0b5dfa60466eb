"""`report.html`: the whole report as one page."""

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from capture.report import HTML_NAME
from capture.report.gates import Gate, Verdict, absent, absent_names, counts, failed
from capture.report.poses_view import poses_view
from capture.report.scene_gates import WHERE, Reconstruction
from capture.report.stack_rules import PICTURE_RULES, picture_verdict
from capture.report.stack_section import ExaminedStack, gate_table, stack_section
from mrbokeh import __version__
from mrbokeh.system.html_page import cell, section, table, write_page

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


@dataclass(frozen=True)
class SceneReport:
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
        """No gate failed, and those that look at the all-in-focus picture were judged, in every stack."""
        looked_at = all(
            any(gate.name == rule.name and gate.verdict is Verdict.PASSED for gate in each.gates)
            for each in self.stacks
            for rule in PICTURE_RULES
        )
        return bool(self.stacks) and looked_at and not self.failures


def write_html(report: SceneReport) -> None:
    """One file in the folder of the scene, with all pictures inside."""
    failures = report.failures
    kind = "missed" if failures else "met" if report.passed else "muted"
    unseen = "" if failures or report.passed else " Not passed: not all gates of the all-in-focus pictures could be judged."
    blocks = [
        f"<h1>Capture report: {report.scene.resolve().name}</h1>",
        f'<p class="{kind}">{html.escape(picture_verdict(report.gates))}. Of all: {counts(report.gates)}.{unseen}</p>',
        f'<p class="muted">Absent: {html.escape(absent_names(report.gates))}.</p>' if report.absences else "",
        f'<p class="muted">Merged stacks: {len(report.stacks)}. mrbokeh {__version__}.</p>',
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
    """Return sections, most failures first; pictures for the first dozen, so that the page stays one that can be opened."""
    ranked = sorted(stacks, key=lambda each: (-each.failures, each.findings.name))
    return [stack_section(each, with_pictures=rank < MOST_WITH_PICTURES) for rank, each in enumerate(ranked)]
