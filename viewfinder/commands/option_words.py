"""Options that several commands of `mrbokeh viewfinder` share, word for word."""

from pathlib import Path
from typing import Annotated

import typer

SOURCE_HELP = "Video played in a loop, number of a webcam, rtsp/http/udp URL, folder:PATH, gphoto2, whip (a browser), or test."

BoardOption = Annotated[Path | None, typer.Option(help="BOARD.json of `mrbokeh viewfinder board`: the camera is tracked by it.")]
CameraOption = Annotated[Path | None, typer.Option(help="CAMERA.json with the source's intrinsics; else those of the lens.")]
PhoneOption = Annotated[
    str | None, typer.Option(metavar="SOURCE", help="Camera of a phone on the hot shoe, which sees --board: whip, or as --source.")
]
PhoneCameraOption = Annotated[Path | None, typer.Option(help="CAMERA.json with the intrinsics of --phone.")]
WidthOption = Annotated[int | None, typer.Option(min=16, metavar="PX", help="Wider pictures are made smaller.")]
PortOption = Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")]
LanOption = Annotated[bool, typer.Option(help="Let this network in, with a one-time token; else only this machine.")]
InterfaceOption = Annotated[str | None, typer.Option(help="With --lan: name or address of the one interface to listen on.")]
TlsOption = Annotated[Path | None, typer.Option(metavar="CERTIFICATE", help="PEM certificate: phones lend their camera over https only.")]
TlsKeyOption = Annotated[Path | None, typer.Option(help="PEM key, where it is not in the certificate's file.")]
QrOption = Annotated[bool, typer.Option("--qr/--no-qr", help="With --lan: print the address as a QR code too.")]
