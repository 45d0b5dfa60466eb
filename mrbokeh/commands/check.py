"""`mrbokeh check`: what is broken in a finished picture, sequence, focal stack or film; for render farms."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.checks.check_shot import CheckSettings, Taken, check_shot
from mrbokeh.checks.checked_picture import open_shot
from mrbokeh.checks.picture_checks import CheckReport
from mrbokeh.commands._option_groups import grouped
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import show, tell

app = typer.Typer(add_completion=False)

_SHOWN = 25


@dataclass(frozen=True)
class SourceOptions:
    """Files that OUT was made from, and its lens."""

    against: Annotated[
        Path | None, typer.Option(metavar="PLATE", help="The photograph, stack, sequence or clip that it was made from.")
    ] = None
    virtual: Annotated[
        Path | None,
        typer.Option(help="Blurred virtual layer (EXR with alpha), for each picture virtual.%04d.exr or a folder; else from layered EXR."),
    ] = None
    sharp: Annotated[
        Path | None, typer.Option(help="The same before the blur, for the ledger of light, and with --lens for the reach.")
    ] = None
    lens: Annotated[Path | None, typer.Option(help="The lens as it was focused for OUT: how far light of --sharp may reach.")] = None
    frames: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="Frames of PLATE from which OUT was made: 1001-1050, 1001-1050x2, 1001,1020.")
    ] = None
    first_number: Annotated[int, typer.Option(help="Number of the first frame of a film, as `mrbokeh video` was told.")] = 0

    @property
    def files(self) -> tuple[Path | None, ...]:
        """Input files of these options."""
        return self.against, self.virtual, self.sharp, self.lens


@dataclass(frozen=True)
class LimitOptions:
    """Differences that are not yet faults."""

    tolerance: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="What an untouched pixel may differ from PLATE: of the sRGB code, in EXR of the light. Default: by the format."
        ),
    ] = None
    energy_tolerance: Annotated[
        float, typer.Option(min=0.0, help="Share of light that may come or go; more where vignetting or exposure changes it.")
    ] = 0.01
    flicker_limit: Annotated[
        float, typer.Option(min=0.0, help="Mean change between frames beyond PLATE's own; more, or inf, where virtual things move.")
    ] = 0.002


@dataclass(frozen=True)
class ReportOptions:
    """Files beside the report."""

    map_out: Annotated[
        Path | None, typer.Option("--leaks", help="Where leaked pixels are shown (.png), written only where there are some.")
    ] = None


@app.command()
@grouped
def check(
    picture: Annotated[
        Path, typer.Argument(metavar="OUT", help="A picture, numbered ones (out.%04d.exr, a folder), a focal stack or a film.")
    ],
    made: SourceOptions,
    limits: LimitOptions,
    result: ReportOptions,
) -> None:
    """Look for NaN, alpha outside 0 to 1, negative light, light made or lost, leaks, flicker, and missing frames.

    Exit code 0: nothing found; 1: findings; 2: cannot be read. The map is replaced where it exists; --json prints all that was found.

    Example: mrbokeh check out.exr --against plate.exr --virtual blurred_layer.exr --leaks leaks.png --json > check.json
    """
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.system.atomic_files import require_safe_outputs

    if result.map_out is not None:
        require_suffix(result.map_out, (".png",), "--leaks")
    require_safe_outputs((result.map_out,), (picture, *made.files), overwrite=True)
    if made.lens is not None and made.sharp is None:
        raise InputError("--lens tells how far light of the sharp layer reaches: give --sharp LAYER.exr too")
    plate = None if made.against is None else open_shot(made.against)
    report, leaks = check_shot(open_shot(picture), plate, _settings(made, limits))
    _print(report)
    if result.map_out is not None and leaks.write(result.map_out):
        tell(f"wrote {result.map_out}")
    raise typer.Exit(0 if report.is_clean else 1)


def _settings(made: SourceOptions, limits: LimitOptions) -> CheckSettings:
    from mrbokeh.renderers.choose import read_lens
    from mrbokeh.video.picture_source import parse_frames

    numbers = None if made.frames is None else sorted({number for each in parse_frames(made.frames) for number in each})
    return CheckSettings(
        layers={name: path for name, path in (("virtual", made.virtual), ("sharp", made.sharp)) if path is not None},
        lens=None if made.lens is None else read_lens(made.lens),
        energy_tolerance=limits.energy_tolerance,
        flicker_limit=limits.flicker_limit,
        tolerance=limits.tolerance,
        taken=Taken(numbers, made.first_number),
    )


def _print(report: CheckReport) -> None:
    from rich.table import Table

    if report.findings:
        table = Table("check", "where", "what", box=None)
        for each in report.findings[:_SHOWN]:
            table.add_row(each.check, each.where, each.text)
        show(table)
    if len(report.findings) > _SHOWN:
        tell(f"and {len(report.findings) - _SHOWN} more: see --json")
    for name, value in sorted(report.measures.items()):
        tell(f"{name}: {value:.6g}")
    for name, needs in sorted(report.skipped.items()):
        tell(f"not checked: {name}: {needs}")
    pictures, findings = report.pictures, len(report.findings)
    told = f"{findings or 'no'} finding{'' if findings == 1 else 's'}"
    tell(f"{pictures} picture{'' if pictures == 1 else 's'} checked, {told}", **report.to_json())
