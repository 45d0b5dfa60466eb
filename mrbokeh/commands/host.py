"""`mrbokeh host`: writes the one file by which another program blurs through `mrbokeh serve`."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from mrbokeh.system.channel import tell

app = typer.Typer(add_completion=False)


class Program(StrEnum):
    """Programs that there is a file for."""

    BLENDER = "blender"


class _File(NamedTuple):
    source: str
    target: str
    installed: str


_FILES = {
    Program.BLENDER: _File("blender.py", "mrbokeh_blender.py", "in Blender, Edit > Preferences > Add-ons > Install from Disk"),
}
CARRIED = "from mrbokeh.hosts.client import Refused, ask\n"
"""Line of a host's file in whose place the client is written."""


def written(program: Program) -> str:
    """Return the file for a program; Python ones carry the client."""
    from importlib.resources import files

    folder = files("mrbokeh.hosts")
    text, client = ((folder / name).read_text(encoding="utf-8") for name in (_FILES[program].source, "client.py"))
    return text.replace(CARRIED, client.partition('"""\n\n')[2])


@app.command("host")
def host(
    program: Annotated[Program, typer.Argument(help="The program in which to blur.")],
    out: Annotated[Path, typer.Option(help="Folder for the file.")] = Path("."),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there already.")] = False,
) -> None:
    """Write the file by which another program blurs through a running `mrbokeh serve`; it says where the file goes.

    The add-on of Blender (4.2 and later) exports objects, camera track and render settings as well.

    Example: mrbokeh host blender --out addons
    """
    from mrbokeh.system.atomic_files import atomic_path, refuse_existing
    from mrbokeh.system.errors import InputError

    if out.exists() and not out.is_dir():
        raise InputError(f"expected a folder for the file, but {out} is a file: name a folder")
    target = out / _FILES[program].target
    refuse_existing(target, overwrite)
    with atomic_path(target) as temporary:
        temporary.write_text(written(program), encoding="utf-8")
    tell(f"wrote {target}: {_FILES[program].installed}")
