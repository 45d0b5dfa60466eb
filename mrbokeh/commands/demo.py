"""`mrbokeh demo`: the whole pipeline on shipped photographs, with a report."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.messages import tell

app = typer.Typer(add_completion=False)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything it makes.")] = Path("demo_out"),
    quick: Annotated[bool, typer.Option("--quick", help="Half a minute, without training: an object in a focus stack.")] = False,
) -> None:
    """Run the whole path from RAW photographs to virtual objects with the blur of their lens: capture, train, composite, report.

    Runs the commands of mrbokeh on shipped photographs and writes report.html (--quick: quick.html). Finished stages are skipped when
    run again, an interrupted one goes on.

    Example: mrbokeh demo --quick --out demo_out
    """
    from mrbokeh.demo.plan import demo_stages, quick_stages
    from mrbokeh.demo.report import write_quick_story, write_story
    from mrbokeh.demo.stages import run_stages

    out.mkdir(parents=True, exist_ok=True)
    if quick:
        write_quick_story(out, run_stages(quick_stages(out / "quick"), out))
        tell(f"\nOpen {(out / 'quick.html').resolve()}")
        return
    measurements = write_story(out, run_stages(demo_stages(out), out))
    for each in measurements:
        tell(f"{'ok    ' if each.met else 'missed'} {each.what}: {each.text} ({each.wanted})")
    tell(f"\nOpen {(out / 'report.html').resolve()}", measurements=[vars(each) for each in measurements])
