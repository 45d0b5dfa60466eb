"""`mrbokeh check`: what is broken in a finished picture, sequence, focal stack or film; for render farms."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.checks.check_shot import CheckSettings, check_shot
from mrbokeh.checks.checked_picture import open_shot
from mrbokeh.checks.picture_checks import CheckReport
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError

app = typer.Typer(add_completion=False)

_SHOWN = 25


@app.command()
def check(
    out: Annotated[Path, typer.Argument(help="A picture, a folder of numbered pictures, a focal stack or a film.")],
    against: Annotated[
        Path | None, typer.Option(metavar="PLATE", help="The photograph, stack, sequence or clip that it was made from.")
    ] = None,
    virtual: Annotated[
        Path | None,
        typer.Option(help="Blurred virtual layer (EXR with alpha), or a folder with one for each picture; else from layered EXR."),
    ] = None,
    sharp: Annotated[
        Path | None, typer.Option(help="The same before the blur, for the ledger of light, and with --lens for the reach.")
    ] = None,
    lens: Annotated[Path | None, typer.Option(help="LENS.json as it was focused for OUT: how far light of --sharp may reach.")] = None,
    frames: Annotated[str, typer.Option(metavar="START:STOP", help="Frames of PLATE from which OUT was made; STOP is left out.")] = ":",
    tolerance: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="What an untouched pixel may differ from PLATE: of the sRGB code, in EXR of the light. Default: by the format."
        ),
    ] = None,
    energy_tolerance: Annotated[
        float, typer.Option(min=0.0, help="Share of light that may come or go; more where vignetting or exposure changes it.")
    ] = 0.01,
    flicker_limit: Annotated[
        float, typer.Option(min=0.0, help="Mean change between frames beyond PLATE's own; more, or inf, where virtual things move.")
    ] = 0.002,
    json_out: Annotated[Path | None, typer.Option("--json", help="Also write all that was found as JSON.")] = None,
    map_out: Annotated[
        Path | None, typer.Option("--map", help="Where leaked pixels are shown (.png), written only where there are some.")
    ] = None,
) -> None:
    """Look for NaN, alpha outside 0 to 1, negative light, light made or lost, leaks, flicker, and missing frames.

    Exit code 0: nothing found; 1: findings; 2: cannot be read. JSON and map are replaced where they exist.

    Example: mrbokeh check out.exr --against plate.exr --virtual blurred_layer.exr --json check.json --map leaks.png
    """
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.system.atomic_files import require_safe_outputs, write_json

    for name, path, suffix in (("--map", map_out, ".png"), ("--json", json_out, ".json")):
        if path is not None:
            require_suffix(path, (suffix,), name)
    require_safe_outputs((json_out, map_out), (out, against, virtual, sharp, lens), overwrite=True)
    if lens is not None and sharp is None:
        raise InputError("--lens tells how far light of the sharp layer reaches: give --sharp LAYER.exr too")
    plate = None if against is None else open_shot(against)
    settings = CheckSettings(_layer_files(virtual, sharp), _lens(lens), energy_tolerance, flicker_limit, tolerance, _frames(frames))
    report, leaks = check_shot(open_shot(out), plate, settings)
    _print(report)
    if json_out is not None:
        write_json(json_out, report.to_json())
    if map_out is not None and leaks.write(map_out):
        typer.echo(f"wrote {map_out}")
    raise typer.Exit(0 if report.is_clean else 1)


def _layer_files(virtual: Path | None, sharp: Path | None) -> dict[str, Path]:
    return {name: path for name, path in (("virtual", virtual), ("sharp", sharp)) if path is not None}


def _lens(path: Path | None) -> Lens | None:
    from mrbokeh.optics.lens_file import read_lens

    return None if path is None else read_lens(path)


def _frames(text: str) -> tuple[int, int | None]:
    from mrbokeh.commands.video import parse_frames

    return parse_frames(text)


def _print(report: CheckReport) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, soft_wrap=True)
    if report.findings:
        table = Table("check", "where", "what", box=None)
        for each in report.findings[:_SHOWN]:
            table.add_row(each.check, each.where, each.text)
        console.print(table)
    if len(report.findings) > _SHOWN:
        console.print(f"and {len(report.findings) - _SHOWN} more: see --json")
    for name, value in sorted(report.measures.items()):
        console.print(f"{name}: {value:.6g}")
    for name, needs in sorted(report.skipped.items()):
        console.print(f"not checked: {name}: {needs}")
    pictures, findings = report.pictures, len(report.findings)
    told = f"{findings or 'no'} finding{'' if findings == 1 else 's'}"
    console.print(f"{pictures} picture{'' if pictures == 1 else 's'} checked, {told}")
