"""`mrbokeh viewfinder`: a camera with a virtual object in it, blurred by the lens, in a browser."""

import asyncio
import contextlib
import logging
import signal
from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.image_io import read_layer
from mrbokeh.lens_file import read_lens
from mrbokeh.renderers.choose import DEFAULT, make_renderer
from viewfinder.focused_layer import FocusedLayer
from viewfinder.pipeline import Pipeline
from viewfinder.server.app import serving
from viewfinder.sources.frame_source import open_source

app = typer.Typer(add_completion=False, no_args_is_help=True)

_LOOPBACK = ("127.0.0.1", "::1", "localhost")


@app.callback()
def viewfinder() -> None:
    """Stream a camera with virtual objects in it to a browser.

    Example: mrbokeh viewfinder serve --source clip.mp4 --layer lantern.exr --lens lens.json
    """


@app.command()
def serve(
    source: Annotated[
        str, typer.Option(metavar="CLIP|CAMERA|test", help="A video played in a loop, the number of a webcam, or a test pattern.")
    ],
    layer: Annotated[Path, typer.Option(metavar="RGBAZ.exr", help="All-in-focus virtual layer; the stream has its size.")],
    lens: Annotated[Path, typer.Option(metavar="LENS.json", help="The lens; its focus is where the slider begins.")],
    renderer: Annotated[str, typer.Option("--renderer", "--method", help="polygon, low-rank, scatter, or a network (.onnx).")] = DEFAULT,
    port: Annotated[int, typer.Option(help="Port of the page; 0 takes a free one.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to listen on; other machines reach only what is not loopback.")] = "127.0.0.1",
    fps: Annotated[float | None, typer.Option(help="At most so many frames per second.")] = None,
) -> None:
    """Serve a page that shows the camera, which does not move, with the virtual layer in it; Ctrl-C ends it.

    Example: mrbokeh viewfinder serve --source 0 --layer lantern.exr --lens lens.json --port 8080
    """
    logging.basicConfig(level=logging.WARNING)
    sharp = read_layer(layer)
    camera = open_source(source, sharp.width_px, sharp.height_px, fps)
    virtual = FocusedLayer(sharp, read_lens(lens), make_renderer(renderer))
    with Pipeline(camera, virtual) as pipeline, contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(pipeline, host, port))
    typer.echo("viewfinder stopped")


async def _serve(pipeline: Pipeline, host: str, port: int) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        # Where signal handlers cannot be set (Windows), Ctrl-C arrives as KeyboardInterrupt.
        with contextlib.suppress(NotImplementedError):
            asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    async with serving(pipeline, host, port) as url:
        typer.echo(f"viewfinder of {pipeline.source.name}: {url} (Ctrl-C stops it)")
        if host not in _LOOPBACK:
            typer.echo("everybody on this network can watch and set the focus: there is no password yet")
        await stopped.wait()
