"""`mrbokeh host`: writes the one file by which another program blurs through `mrbokeh serve`."""

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from mrbokeh.system.messages import tell

app = typer.Typer(add_completion=False)


class Program(StrEnum):
    """Programs that there is a file for."""

    BLENDER = "blender"
    NUKE = "nuke"
    NATRON = "natron"
    FUSION = "fusion"


class _File(NamedTuple):
    source: str
    target: str
    installed: str


_FILES = {
    Program.BLENDER: _File("blender.py", "mrbokeh_blender.py", "in Blender, Edit > Preferences > Add-ons > Install from Disk"),
    Program.NUKE: _File("nuke.py", "mrbokeh_nuke.py", "put it into ~/.nuke, with `import mrbokeh_nuke` in ~/.nuke/menu.py"),
    Program.NATRON: _File("natron.py", "mrbokeh_natron.py", "put it into a folder of Natron's search path for plug-ins"),
    Program.FUSION: _File("fusion.fuse", "mrbokeh_lens_blur.fuse", "put it into Fusion's folder Fuses"),
}
_CARRIED = re.compile(r"^from mrbokeh\.hosts\.client import .*\n", re.MULTILINE)
"""Line of a host's file in whose place the client is written."""


def written(program: Program) -> str:
    """Return the file for a program; Python ones carry the client."""
    from importlib.resources import files

    folder = files("mrbokeh.hosts")
    text, client = ((folder / name).read_text(encoding="utf-8") for name in (_FILES[program].source, "client.py"))
    return _CARRIED.sub(lambda _: client.partition('"""\n\n')[2], text)


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

    name = _FILES[program].target
    if not out.is_dir() and (out.exists() or out.suffix.lower() == Path(name).suffix):
        raise InputError(f"expected a folder, in which {name} is put, got {out}: name a folder")
    target = out / name
    refuse_existing(target, overwrite, "give another folder as --out")
    with atomic_path(target) as temporary:
        temporary.write_text(written(program), encoding="utf-8")
    tell(f"wrote {target}: {_FILES[program].installed}")
