"""The page of the bench: crashes first, bars, tables of all figures beside the peers, and crops at 100 % of the worst places."""

import base64
import html
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from mrbokeh.system.html_page import cell, section, table, write_page
from tests.bench.fusion_measures import MEASURES
from tests.bench.real_pairs import Agreement, Ranking
from tests.bench.real_result import OURS, TOP_BAR, StackResult
from tests.bench.real_stack import Figures

LOST_BAR, FLAT_BAR = 0.002, 1.1
RANK_BAR = 3.0
RENDERED_BAR_DB, RESIDUALS_BAR_DB = 33.0, 36.0
CORRELATION_BAR = 0.99
STYLE = """
.crops { display: flex; flex-wrap: wrap; gap: 6px; margin: .3rem 0 1rem; } .crops figure { margin: 0; max-width: none; }
.crops img { max-width: none; display: block; } td { font-variant-numeric: tabular-nums; } .wide td { min-width: 2.5rem; }
"""


@dataclass(frozen=True)
class Bench:
    """All that was measured. told: lines about machine, peers, what is not there. agreements: of our measures with published values."""

    results: Sequence[StackResult]
    peers: Sequence[str]
    told: Sequence[str]
    crops: Path
    ranking: Ranking | None = None
    agreements: Sequence[Agreement] = field(default_factory=list)

    @property
    def stacks(self) -> list[StackResult]:
        return [result for result in self.results if not result.name.startswith("lytro_pairs/")]


@dataclass(frozen=True)
class Bar:
    """met: None where nothing was measured."""

    name: str
    wanted: str
    found: str
    met: bool | None


def lost_met(result: StackResult) -> bool | None:
    """At most LOST_BAR, and never more than a peer's."""
    return _met(result, lambda figures: figures.lost, LOST_BAR, min)


def flat_met(result: StackResult) -> bool | None:
    """At most FLAT_BAR, or no more than the better peer's where that is higher."""
    return _met(result, lambda figures: figures.flat, FLAT_BAR, max)


def _met(result: StackResult, of: Callable[[Figures], float | None], bar: float, which: Callable[[float, float], float]) -> bool | None:
    ours = of(result.ours) if result.ours else None
    if ours is None:
        return None
    peers = [value for name, figures in result.figures.items() if name != OURS and (value := of(figures)) is not None]
    return ours <= (which(bar, min(peers)) if peers else bar)


def top_met(result: StackResult) -> bool | None:
    return None if result.ours is None or result.ours.top is None else result.ours.top <= TOP_BAR


def bars(bench: Bench) -> list[Bar]:
    stacks, failed = bench.stacks, [result for result in bench.results if result.failure]
    found = [Bar("every stack and pair runs", "no failure", f"{len(failed)} of {len(bench.results)} failed", not failed)]
    laws = (("lost blocks", "0.2 %, no more than a peer's", lost_met), ("flat zones", "1.1, or the better peer's", flat_met))
    for name, wanted, law in (*laws, ("largest value", f"{TOP_BAR:g} times the slices'", top_met)):
        verdicts = [law(result) for result in stacks]
        found.append(_share(name, wanted, [verdict for verdict in verdicts if verdict is not None]))
    if bench.ranking:
        rank = bench.ranking.mean_rank()
        of_means = ", ".join(f"{each:g}" for each in bench.ranking.rank_of_means())
        text = f"{rank:.2f} of {len(bench.ranking.methods)} over {len(bench.ranking.pairs)} pairs; of the measures' means {of_means}"
        found.append(Bar("mean rank of fused pairs", f"at most {RANK_BAR:g}", text, rank <= RANK_BAR))
    found += _refocus_bars([result for result in stacks if result.name.startswith("lytro_stacks/")])
    focus = [result for result in stacks if result.focus]
    correlations = [result.focus.correlation for result in focus if result.focus and result.focus.correlation is not None]
    if focus:
        text = ", ".join(f"{result.name} {_number(result.focus.correlation, '.4f')}" for result in focus if result.focus)
        met = len(correlations) == len(focus) and min(correlations) >= CORRELATION_BAR
        found.append(Bar("focus positions beside stated ones", f"correlation of {CORRELATION_BAR:g}", text, met))
    return found


def _share(name: str, wanted: str, verdicts: list[bool]) -> Bar:
    missed = verdicts.count(False)
    return Bar(name, wanted, f"{missed} of {len(verdicts)} stacks miss it", not missed if verdicts else None)


def _refocus_bars(lytro: list[StackResult]) -> Iterator[Bar]:
    measured = [result.refocus for result in lytro if result.refocus]
    if not measured:
        return
    for what, bar in (("rendered", RENDERED_BAR_DB), ("with_residuals", RESIDUALS_BAR_DB)):
        values = [value for each in measured if (value := getattr(each, f"{what}_db")) is not None]
        middle = median(values) if values else None
        text = f"{_number(middle, '.1f')} dB, median of {len(values)}; {len(measured) - len(values)} refused"
        name = f"a Lytro slice left out, {what.replace('_', ' ')}"
        yield Bar(name, f"{bar:g} dB", text, None if middle is None else middle >= bar)


def ratios(bench: Bench) -> dict[str, float]:
    """Median CPU seconds of ingest and merge over those of each peer."""
    found = {}
    for peer in bench.peers:
        both = [(result.ours.cpu_s, result.figures[peer].cpu_s) for result in bench.stacks if result.ours and peer in result.figures]
        known = [ours / theirs for ours, theirs in both if ours and theirs and math.isfinite(theirs)]
        if known:
            found[peer] = median(known)
    return found


def write_bench_page(path: Path, bench: Bench) -> None:
    blocks = [f"<h1>Real focus stacks</h1><p>{'<br>'.join(html.escape(line) for line in bench.told)}</p>"]
    failed = [result for result in bench.results if result.failure]
    rows = [(cell(result.name), cell(result.failure, "missed")) for result in failed]
    text = f"{len(failed)} of {len(bench.results)} stacks and pairs did not come to their end."
    blocks.append(section("Failures", text, [table(("stack", "last line"), rows)] if rows else []))
    blocks.append(section("Bars", "", [table(("bar", "wanted", "found"), [_bar_row(bar) for bar in bars(bench)])]))
    speeds = "; ".join(f"{ratio:.2f} times the CPU seconds of {peer} (median of ratios)" for peer, ratio in ratios(bench).items())
    blocks.append(section("Stacks", f"CPU seconds are those of ingest and merge, the report's apart. {speeds}", [_stack_table(bench)]))
    if bench.ranking:
        blocks.append(_pairs_section(bench.ranking, bench.agreements))
    blocks.append(section("Stack by stack", "Crops at 100 % of the worst places, beside the sharpest slice and the peers.", _crops(bench)))
    write_page(path, "Real focus stacks", blocks, STYLE)


def _bar_row(bar: Bar) -> tuple[str, ...]:
    return cell(bar.name), cell(bar.wanted), cell(bar.found, _kind(bar.met))


def _kind(met: bool | None) -> str:
    return "muted" if met is None else "met" if met else "missed"


def _stack_table(bench: Bench) -> str:
    headings = ["stack", "slices", "size"]
    for name in (OURS, *bench.peers):
        headings += [f"{name}: lost %", "flat", "top", "unlike %", "CPU s", "MB"]
    headings += ["report CPU s", "gates judged", "failed", "left out dB", "with residuals", "focus"]
    return table(headings, [_stack_row(result, bench.peers) for result in bench.results])


def _stack_row(result: StackResult, peers: Sequence[str]) -> list[str]:
    size = f"{result.size[1]}x{result.size[0]}" if result.size else "-"
    cells = [cell(result.name), cell(str(result.photographs), "number"), cell(size)]
    cells += _figure_cells(result.ours or Figures(said=result.failure), (lost_met(result), flat_met(result), top_met(result)))
    for peer in peers:
        cells += _figure_cells(result.figures.get(peer) or Figures(), (None, None, None))
    report, gates, refocus, focus = result.costs.get("process"), result.gates, result.refocus, result.focus
    cells.append(cell(f"{report[0]:.1f}" if report else "-", "number"))
    cells.append(cell(f"{gates['judged']} of {gates['gates']}" if gates else "-"))
    cells.append(cell(str(len(gates["failed"])) if gates else "-", "number"))
    cells.append(cell(_number(refocus.rendered_db, ".1f") if refocus else "-", "number"))
    cells.append(cell(_number(refocus.with_residuals_db, ".1f") if refocus else "-", "number"))
    cells.append(cell(_number(focus.correlation, ".4f") if focus else "-", "number"))
    return cells


def _figure_cells(figures: Figures, met: tuple[bool | None, bool | None, bool | None]) -> Iterator[str]:
    lost = None if figures.lost is None else 100.0 * figures.lost
    for value, style, verdict in zip((lost, figures.flat, figures.top), (".2f", ".2f", ".2f"), met, strict=True):
        yield cell(_number(value, style), _kind(verdict) if verdict is not None else "number")
    yield cell(_number(None if figures.unlike is None else 100.0 * figures.unlike, ".3f"), "number")
    yield cell(_number(figures.cpu_s, ".1f"), "number")
    yield cell(_number(figures.memory_mb, ".0f"), "number")


def _number(value: float | None, style: str) -> str:
    return "-" if value is None else format(value, style)


def _pairs_section(ranking: Ranking, agreements: Sequence[Agreement]) -> str:
    headings = ["method", "mean rank", *(f"rank by {name}" for name in MEASURES), *(f"mean {name}" for name in MEASURES)]
    rows = []
    for method, rank, by_measure, means in ranking.table():
        kind = "met" if method == OURS else "number"
        numbers = [f"{rank:.2f}", *(f"{each:.1f}" for each in by_measure), *(f"{each:.4f}" for each in means)]
        rows.append([cell(method, kind), *(cell(number, kind) for number in numbers)])
    beside = [_agreement_row(each) for each in agreements]
    checked = table(["method", "published row", *MEASURES, "pairs far from the published values"], beside)
    note = "<h3>Our measures of published fused pictures, less the published values: median over the pairs ± median deviation</h3>"
    text = f"{len(ranking.pairs)} pairs, ranks among {len(ranking.methods)}; 1 is best."
    return section("Pairs", text, [table(headings, rows), note, checked if beside else "<p>No published row was recognised.</p>"])


def _agreement_row(each: Agreement) -> list[str]:
    numbers = [f"{middle:+.4f} ± {spread:.4f}" for middle, spread in zip(each.median, each.spread, strict=True)]
    return [cell(text) for text in (each.method, str(each.row), *numbers, ", ".join(each.odd) or "none")]


def _crops(bench: Bench) -> Iterator[str]:
    for result in bench.results:
        if notes := list(_notes(result)):
            yield f'<h3>{html.escape(result.name)}</h3><div class="muted">{html.escape("; ".join(notes))}</div>'
        for shown in result.shown:
            figures = (_crop(bench.crops / crop.file, crop.name) for crop in shown.crops)
            place = f"{shown.place.said}, at ({shown.place.x}, {shown.place.y})"
            yield f'<div class="muted">{html.escape(place)}</div><div class="crops">{"".join(figures)}</div>'


def _notes(result: StackResult) -> Iterator[str]:
    """What does not go into the table."""
    if result.gates:
        yield f"gates failed: {', '.join(result.gates['failed']) or 'none'}"
    if result.refocus:
        yield f"left out: {result.refocus.said}"
    if result.focus:
        yield f"focus positions: {result.focus.said}"
    yield from (f"{name}: {figures.said}" for name, figures in result.figures.items() if figures.said)


def _crop(path: Path, name: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    text = html.escape(name)
    return f'<figure><img src="data:image/jpeg;base64,{data}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def summary_lines(bench: Bench) -> Iterable[str]:
    """The bars in plain text, as they are printed."""
    for bar in bars(bench):
        verdict = {None: "not measured", True: "met", False: "MISSED"}[bar.met]
        yield f"{verdict:12s} {bar.name}: {bar.found} (wanted: {bar.wanted})"
    yield from (
        f"{ratio:.2f} times the CPU seconds of {peer} (median of ratios, ingest and merge)" for peer, ratio in ratios(bench).items()
    )
