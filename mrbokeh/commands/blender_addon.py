"""`mrbokeh blender-addon`: writes the add-on for Blender that exports scenes for mrbokeh."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.channel import tell

app = typer.Typer(add_completion=False)


@app.command()
def blender_addon(
    out: Annotated[Path, typer.Option(help="Folder for the add-on, mrbokeh_export.py.")] = Path("."),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an add-on that is there already.")] = False,
) -> None:
    """Write the Blender add-on (4.2 and later) that exports objects, camera track and render settings for mrbokeh.

    In Blender: Edit > Preferences > Add-ons > Install from Disk, then File > Export > mrbokeh (folder).

    Example: mrbokeh blender-addon --out addons
    """
    from importlib.resources import files

    from mrbokeh.system.atomic_files import atomic_path, refuse_existing
    from mrbokeh.system.errors import InputError

    if out.exists() and not out.is_dir():
        raise InputError(f"expected a folder for the add-on, but {out} is a file: name a folder")
    source, target = files("mrbokeh.scene") / "blender_addon.py", out / "mrbokeh_export.py"
    refuse_existing(target, overwrite)
    with atomic_path(target) as temporary:
        temporary.write_bytes(source.read_bytes())
    tell(f"wrote {target}: in Blender, Edit > Preferences > Add-ons > Install from Disk")
