"""`mrbokeh studio`: objects placed in one photograph, in a browser."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.messages import say
from viewfinder.cli import InterfaceOption, LanOption, PortOption, QrOption, TlsKeyOption, TlsOption
from viewfinder.options import ListeningOptions

app = typer.Typer(add_completion=False)


@app.command()
def studio(
    photo: Annotated[
        Path | None,
        typer.Argument(
            metavar="PHOTO",
            help="A photograph (RAW, JPEG, HEIC, TIFF, PNG), the folder of a merged focal stack, a clip with --camera, or the .json "
            "project of an earlier time.",
        ),
    ] = None,
    object_: Annotated[
        list[Path] | None, typer.Option("--object", help="GLB file to render and put in (repeat: the page offers them).")
    ] = None,
    depth: Annotated[
        Path | None,
        typer.Option(
            help="Depth of the photograph: EXR with Z, PNG or TIFF, a phone's photograph. Default: PHOTO's own, else level ground."
        ),
    ] = None,
    lens: Annotated[
        list[Path] | None,
        typer.Option(
            help="LENS.json, a name of `lens list`, a bank (folder) or NETWORK.onnx (repeat: the page switches); else the photograph's."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(metavar="TRACK", help="Track of a clip's camera: objects are placed in the first frame, `mrbokeh video` films them."),
    ] = None,
    project: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="Keep everything here, and go on with what is there. Default: PHOTO's name + .studio.json."),
    ] = None,
    pictures: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for saved pictures and for files dropped on the page.")] = Path(),
    port: PortOption = 8080,
    lan: LanOption = False,
    interface: InterfaceOption = None,
    tls: TlsOption = None,
    tls_key: TlsKeyOption = None,
    qr: QrOption = True,
) -> None:
    """Place objects in a photograph with the mouse or a finger, see them with the lens's blur, and save that; Ctrl-C ends it.

    Every state shows the `mrbokeh composite` command that makes the same picture. Without PHOTO the page asks for one.

    Example: mrbokeh studio photo.jpg --object cake.glb

    Example: mrbokeh studio SCENE/view_2 --object cake.glb

    Example: mrbokeh studio clip.mp4 --camera track.json --object cake.glb

    Example: mrbokeh studio photo.studio.json --lan
    """
    say("mrbokeh studio starts")
    from viewfinder.studio.running import StudioOptions, serve

    listening = ListeningOptions(port=port, lan=lan, interface=interface, tls=tls, tls_key=tls_key, qr=qr)
    serve(
        StudioOptions(
            photo=photo,
            objects=tuple(object_ or ()),
            depth=depth,
            lenses=tuple(lens or ()),
            camera=camera,
            project=project,
            pictures=pictures,
            listening=listening,
        )
    )
