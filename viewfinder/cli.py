"""`mrbokeh viewfinder`: a camera with virtual objects in it, blurred by the lens, in a browser."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.errors import InputError
from viewfinder.commands import option_words as words
from viewfinder.commands.board import board_command
from viewfinder.commands.calibrate_phone import calibrate_phone_command

if TYPE_CHECKING:
    from viewfinder.app.tracking_choice import PhoneChoice

app = typer.Typer(add_completion=False)
app.command("board")(board_command)
app.command("calibrate-phone")(calibrate_phone_command)


@app.callback(invoke_without_command=True)
def viewfinder(
    context: typer.Context,
    source: Annotated[str | None, typer.Option(help=words.SOURCE_HELP)] = None,
    scene: Annotated[Path | None, typer.Option(help="SCENE.toml: objects, light, shadow, lens; read again when it changes.")] = None,
    layer: Annotated[
        Path | None, typer.Option(metavar="RGBAZ.exr", help="Instead of a scene: an all-in-focus layer before a camera that stands still.")
    ] = None,
    lens: Annotated[
        list[Path] | None, typer.Option(help="LENS.json, or NETWORK.onnx (repeat: the page switches between them); else the scene's.")
    ] = None,
    renderer: Annotated[
        list[str] | None,
        typer.Option("--renderer", "--method", help="polygon, low-rank, scatter, laplacian (repeat to switch on the page)."),
    ] = None,
    backend: Annotated[str, typer.Option(help="What draws the scene: wgpu (a graphics card), embree (the processor), or auto.")] = "auto",
    psf: Annotated[
        Path | None, typer.Option(help="A measured bank of kernels (of `mrbokeh lens fit`) in place of the lens's opening.")
    ] = None,
    board: words.BoardOption = None,
    pose: Annotated[Path | None, typer.Option(help="CAMERA.json: the camera stands still, with this pose and these intrinsics.")] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", help="Folder of a COLMAP map with its pictures: the camera is localised in it.")
    ] = None,
    metres_per_unit: Annotated[float | None, typer.Option(help="Scale of --map, where it does not tell.")] = None,
    opentrackio: Annotated[int | None, typer.Option(min=1, max=65535, metavar="PORT", help="UDP port where OpenTrackIO comes in.")] = None,
    freed: Annotated[int | None, typer.Option(min=1, max=65535, metavar="PORT", help="UDP port where FreeD comes in.")] = None,
    lens_table: Annotated[Path | None, typer.Option(help="CSV that turns FreeD's encoder counts into focus and zoom.")] = None,
    phone: words.PhoneOption = None,
    phone_camera: words.PhoneCameraOption = None,
    rig: Annotated[Path | None, typer.Option(help="RIG.json of `mrbokeh viewfinder calibrate-phone`: where --phone sits.")] = None,
    delay_ms: Annotated[float, typer.Option(help="How much later the picture comes than a pose from --phone or a tracking system.")] = 0.0,
    camera: words.CameraOption = None,
    focus_from: Annotated[
        list[str] | None,
        typer.Option(help="Who is asked first for the focus: hand (the page), tracking, source, board (its blur); repeat for an order."),
    ] = None,
    smoothing: Annotated[bool, typer.Option(help="Smooth the track (One-Euro); the page can switch it.")] = False,
    width: words.WidthOption = 640,
    fps: Annotated[float | None, typer.Option(help="At most so many frames per second.")] = None,
    captures: Annotated[Path, typer.Option(help="Folder for captured bundles and recordings.")] = Path("captures"),
    webcam: Annotated[
        str | None,
        typer.Option(metavar="DEVICE", help="Also show it as a webcam for OBS or Zoom: its name (/dev/video9), or auto."),
    ] = None,
    port: words.PortOption = 8080,
    lan: words.LanOption = False,
    interface: words.InterfaceOption = None,
    tls: words.TlsOption = None,
    tls_key: words.TlsKeyOption = None,
    qr: words.QrOption = True,
) -> None:
    """Show a camera with virtual objects in it, blurred by the lens, on a page for phones; Ctrl-C ends it.

    Example: mrbokeh viewfinder --source 0 --scene table.toml --board board.json --lens lens.json --lan

    Example: mrbokeh viewfinder --source clip.mp4 --layer lantern.exr --lens lens.json
    """
    if context.invoked_subcommand is not None:
        return
    if source is None:
        typer.echo(context.get_help())
        raise typer.Exit(2)
    from viewfinder.app.tracking_choice import TrackingChoice
    from viewfinder.commands.listening import ListeningOptions
    from viewfinder.commands.serve import serve
    from viewfinder.commands.serve_options import ServeOptions

    logging.basicConfig(level=logging.WARNING)
    listening = ListeningOptions(port, lan, interface, tls, tls_key, qr)
    of_phone = _phone_choice(phone, phone_camera, rig)
    host = listening.host if opentrackio is not None or freed is not None else "127.0.0.1"
    tracking = TrackingChoice(board, pose, map_, metres_per_unit, opentrackio, freed, lens_table, host, of_phone, delay_ms)
    serve(
        ServeOptions(
            source,
            scene,
            layer,
            tuple(lens or ()),
            tuple(renderer or ()),
            psf,
            backend,
            tracking,
            camera,
            tuple(focus_from or ()),
            smoothing,
            width,
            fps,
            captures,
            webcam,
            listening,
        )
    )


def _phone_choice(source: str | None, camera: Path | None, rig: Path | None) -> "PhoneChoice | None":
    """All three of them or none."""
    from viewfinder.app.tracking_choice import PhoneChoice

    for word, given in (("--phone-camera", camera), ("--rig", rig)):
        if source is None and given is not None:
            raise InputError(f"{word} is for --phone: say where the phone's camera comes from, or leave it out")
        if source is not None and given is None:
            made = (
                "CAMERA.json, its intrinsics"
                if word == "--phone-camera"
                else "RIG.json (make it with `mrbokeh viewfinder calibrate-phone`)"
            )
            raise InputError(f"--phone needs {word} {made}")
    return None if source is None or camera is None or rig is None else PhoneChoice(source, camera, rig)
