"""`mrbokeh viewfinder calibrate-phone`: where a phone sits on the camera, from what both see of one board."""

from pathlib import Path
from typing import Annotated

import typer

from viewfinder.commands import option_words as words


def calibrate_phone_command(
    source: Annotated[str, typer.Option(help=f"The camera. {words.SOURCE_HELP}")],
    phone: Annotated[str, typer.Option(metavar="SOURCE", help="The phone's camera: whip (its browser), or as --source.")],
    phone_camera: Annotated[Path, typer.Option(help="CAMERA.json with the intrinsics of --phone.")],
    board: Annotated[Path, typer.Option(help="BOARD.json of `mrbokeh viewfinder board`, which both see.")],
    out: Annotated[Path, typer.Option(help="RIG.json to write, for --rig.")],
    camera: words.CameraOption = None,
    lens: Annotated[Path | None, typer.Option(help="LENS.json, for the intrinsics where there is no --camera.")] = None,
    pairs: Annotated[int, typer.Option(min=5, help="How many views to take.")] = 12,
    seconds: Annotated[float, typer.Option(min=1.0, help="After so long it ends with the views that there are.")] = 300.0,
    width: words.WidthOption = 1280,
    port: words.PortOption = 8080,
    lan: words.LanOption = False,
    interface: words.InterfaceOption = None,
    tls: words.TlsOption = None,
    tls_key: words.TlsKeyOption = None,
    qr: words.QrOption = True,
    overwrite: Annotated[bool, typer.Option(help="Replace RIG.json if it exists.")] = False,
) -> None:
    """Find out where a phone sits on the camera's hot shoe; show both the board from many sides, and hold still each time.

    Stop the lens down for this: the camera too must see the board sharply.

    Example: mrbokeh viewfinder calibrate-phone --source gphoto2 --phone whip --phone-camera phone.json --lens lens.json
    --board board.json --out rig.json --lan --tls phone.pem
    """
    from viewfinder.commands.listening import ListeningOptions
    from viewfinder.commands.phone_session import PhoneSession, calibrate

    calibrate(
        PhoneSession(
            source,
            phone,
            phone_camera,
            board,
            camera,
            lens,
            pairs,
            seconds,
            width,
            ListeningOptions(port, lan, interface, tls, tls_key, qr),
        ),
        out,
        overwrite,
    )
