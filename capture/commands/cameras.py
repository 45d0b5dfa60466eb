"""`mrbokeh capture cameras`: which cameras are connected, and what each can do."""

import typer

from mrbokeh.system.messages import show, tell

HELP = "\n\n".join(
    (
        "List the cameras that libgphoto2 finds, and what each can do over the cable: release, drive the focus, live view, RAW.",
        "Where the focus cannot be driven, `mrbokeh capture shoot --by-hand` tells where to turn the ring.",
        "Example:  mrbokeh capture cameras",
    )
)


def cameras_command() -> None:
    from rich.table import Table

    from capture.tether.camera_driver import Ability
    from capture.tether.gphoto2_camera import list_cameras
    from mrbokeh.system.gphoto2_library import NOTHING_FOUND

    cameras = list_cameras()
    if not cameras:
        tell(NOTHING_FOUND)
        raise typer.Exit(1)
    table = Table("camera", "port", *(str(each) for each in Ability), "")
    for found in cameras:
        abilities = found.description.abilities if found.description else frozenset()
        table.add_row(found.model, found.port, *("yes" if each in abilities else "-" for each in Ability), found.problem)
    show(table, cameras=[{"model": each.model, "port": each.port} for each in cameras])
