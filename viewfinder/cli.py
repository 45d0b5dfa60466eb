"""`mrbokeh viewfinder`: a camera with virtual objects in it, blurred by the lens, in a browser."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from viewfinder.commands.board import board_command

app = typer.Typer(add_completion=False)
app.command("board")(board_command)


@app.callback(invoke_without_command=True)
def viewfinder(
    context: typer.Context,
    source: Annotated[
        str | None,
        typer.Option(
            help="Video played in a loop, number of a webcam, rtsp/http/udp URL, folder:PATH, gphoto2, whip (a browser), or test."
        ),
    ] = None,
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
    board: Annotated[Path | None, typer.Option(help="BOARD.json of `mrbokeh viewfinder board`: the camera is tracked by it.")] = None,
    pose: Annotated[Path | None, typer.Option(help="CAMERA.json: the camera stands still, with this pose and these intrinsics.")] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", help="Folder of a COLMAP map with its pictures: the camera is localised in it.")
    ] = None,
    metres_per_unit: Annotated[float | None, typer.Option(help="Scale of --map, where it does not tell.")] = None,
    opentrackio: Annotated[int | None, typer.Option(metavar="PORT", help="UDP port where OpenTrackIO comes in.")] = None,
    freed: Annotated[int | None, typer.Option(metavar="PORT", help="UDP port where FreeD comes in.")] = None,
    lens_table: Annotated[Path | None, typer.Option(help="CSV that turns FreeD's encoder counts into focus and zoom.")] = None,
    camera: Annotated[Path | None, typer.Option(help="CAMERA.json with the source's intrinsics; else those of the lens.")] = None,
    smoothing: Annotated[bool, typer.Option(help="Smooth the track (One-Euro); the page can switch it.")] = False,
    width: Annotated[int | None, typer.Option(min=16, metavar="PX", help="Wider pictures are made smaller.")] = 640,
    fps: Annotated[float | None, typer.Option(help="At most so many frames per second.")] = None,
    captures: Annotated[Path, typer.Option(help="Folder for captured bundles and recordings.")] = Path("captures"),
    port: Annotated[int, typer.Option(help="Port of the page; 0 takes a free one.")] = 8080,
    lan: Annotated[bool, typer.Option(help="Let this network in, with a one-time token; else only this machine.")] = False,
    interface: Annotated[str | None, typer.Option(help="With --lan: name or address of the one interface to listen on.")] = None,
    tls: Annotated[
        Path | None, typer.Option(metavar="CERTIFICATE", help="PEM certificate: phones lend their camera over https only.")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option(help="PEM key, where it is not in the certificate's file.")] = None,
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
    from viewfinder.assembly import TrackingChoice
    from viewfinder.commands.serve import ServeOptions, listening_address, serve

    logging.basicConfig(level=logging.WARNING)
    at = (interface or "") if lan else None
    tracking = TrackingChoice(board, pose, map_, metres_per_unit, opentrackio, freed, lens_table, listening_address(at))
    lenses, renderers = tuple(lens or ()), tuple(renderer or ())
    serve(
        ServeOptions(
            source, scene, layer, lenses, renderers, psf, tracking, camera, smoothing, width, fps, captures, port, at, tls, tls_key, backend
        )
    )
