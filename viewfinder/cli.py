"""`mrbokeh viewfinder`: a camera with virtual objects in it, blurred by the lens, in a browser."""

from pathlib import Path
from typing import Annotated

import typer

import mrbokeh
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, tell
from viewfinder.options import CalibrationOptions, ListeningOptions, PhoneOptions, TrackingOptions, ViewfinderOptions

app = typer.Typer(add_completion=False)

_SOURCE_HELP = "Video played in a loop, number of a webcam, rtsp/http/udp URL, folder:PATH, gphoto2, whip (a browser), or test."

_DEMO = Path(mrbokeh.__file__).parent / "demo_data" / "live"

BoardOption = Annotated[Path | None, typer.Option(help="BOARD.json of `mrbokeh viewfinder board`: the camera is tracked by it.")]
CameraOption = Annotated[Path | None, typer.Option(help="CAMERA.json with the source's intrinsics; else those of the lens.")]
PhoneOption = Annotated[
    str | None, typer.Option(metavar="SOURCE", help="Camera of a phone on the hot shoe, which sees --board: whip, or as --source.")
]
PhoneCameraOption = Annotated[Path | None, typer.Option(help="CAMERA.json with the intrinsics of --phone.")]
MaxWidthOption = Annotated[int | None, typer.Option(min=16, metavar="PX", help="Wider pictures are made smaller.")]
PortOption = Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")]
LanOption = Annotated[bool, typer.Option(help="Let this network in, with a one-time token; else only this machine.")]
InterfaceOption = Annotated[str | None, typer.Option(help="With --lan: name or address of the one interface to listen on.")]
TlsOption = Annotated[Path | None, typer.Option(metavar="CERTIFICATE", help="PEM certificate: phones lend their camera over https only.")]
TlsKeyOption = Annotated[Path | None, typer.Option(help="PEM key, where it is not in the certificate's file.")]
QrOption = Annotated[bool, typer.Option("--qr/--no-qr", help="With --lan: print the address as a QR code too.")]


@app.callback(invoke_without_command=True)
def viewfinder(
    context: typer.Context,
    source: Annotated[str | None, typer.Option(help=_SOURCE_HELP)] = None,
    demo: Annotated[bool, typer.Option("--demo", help="The shipped clip, board, lens and cake instead of your own.")] = False,
    scene: Annotated[Path | None, typer.Option(help="SCENE.toml: objects, light, shadow, lens; read again when it changes.")] = None,
    layer: Annotated[
        Path | None, typer.Option(metavar="RGBAZ.exr", help="Instead of a scene: an all-in-focus layer before a camera that stands still.")
    ] = None,
    lens: Annotated[
        list[Path] | None,
        typer.Option(
            help="LENS.json, a name of `lens list`, a bank (folder) or NETWORK.onnx (repeat: the page switches); else the scene's."
        ),
    ] = None,
    renderer: Annotated[
        list[str] | None,
        typer.Option("--renderer", help="polygon, low-rank, scatter, laplacian (repeat to switch on the page)."),
    ] = None,
    scene_renderer: Annotated[
        str, typer.Option(help="What draws the scene: wgpu (a graphics card), embree (the processor), or auto.")
    ] = "auto",
    board: BoardOption = None,
    pose: Annotated[Path | None, typer.Option(help="CAMERA.json: the camera stands still, with this pose and these intrinsics.")] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", help="Folder of a COLMAP map with its pictures: the camera is localised in it.")
    ] = None,
    metres_per_unit: Annotated[float | None, typer.Option(help="Scale of --map, where it does not tell.")] = None,
    opentrackio: Annotated[int | None, typer.Option(min=1, max=65535, metavar="PORT", help="UDP port where OpenTrackIO comes in.")] = None,
    freed: Annotated[int | None, typer.Option(min=1, max=65535, metavar="PORT", help="UDP port where FreeD comes in.")] = None,
    lens_table: Annotated[Path | None, typer.Option(help="CSV that turns FreeD's encoder counts into focus and zoom.")] = None,
    phone: PhoneOption = None,
    phone_camera: PhoneCameraOption = None,
    rig: Annotated[Path | None, typer.Option(help="RIG.json of `mrbokeh viewfinder calibrate-phone`: where --phone sits.")] = None,
    delay: Annotated[float, typer.Option(help="How much later the picture comes than a pose from --phone or a tracking system.")] = 0.0,
    camera: CameraOption = None,
    focus_from: Annotated[
        list[str] | None,
        typer.Option(help="Who is asked first for the focus: hand (the page), tracking, source, board (its blur); repeat for an order."),
    ] = None,
    smooth: Annotated[bool, typer.Option(help="Smooth the track (One-Euro); the page can switch it.")] = False,
    max_width: MaxWidthOption = 640,
    max_rate: Annotated[float | None, typer.Option(help="At most so many frames per second.")] = None,
    captures: Annotated[Path, typer.Option(help="Folder for captured bundles and recordings.")] = Path("captures"),
    webcam: Annotated[
        str | None,
        typer.Option(metavar="DEVICE", help="Also show it as a webcam for OBS or Zoom: its name (/dev/video9), or auto."),
    ] = None,
    port: PortOption = 8080,
    lan: LanOption = False,
    interface: InterfaceOption = None,
    tls: TlsOption = None,
    tls_key: TlsKeyOption = None,
    qr: QrOption = True,
) -> None:
    """Show a camera with virtual objects in it, blurred by the lens, on a page for phones; Ctrl-C ends it.

    Example: mrbokeh viewfinder --demo

    Example: mrbokeh viewfinder --source 0 --scene table.toml --board board.json --lens lens.json --lan

    Example: mrbokeh viewfinder --source clip.mp4 --layer lantern.exr --lens lens.json
    """
    if context.invoked_subcommand is not None:
        return
    if demo and source is not None:
        raise InputError(f"--demo shows the shipped clip, but --source is {source}: give one of them")
    if demo:
        source, board, lens = str(_DEMO / "clip.mp4"), board or _DEMO / "board.json", lens or [_DEMO / "lens.json"]
        scene = scene or (_DEMO / "scene.toml" if layer is None else None)
    if source is None:
        say(context.get_help())
        raise InputError("nothing to show: expected --source (a clip, a webcam's number, a URL, or test), or --demo for the shipped clip")
    from viewfinder.app.running import serve

    serve(
        ViewfinderOptions(
            source=source,
            scene=scene,
            layer=layer,
            lenses=tuple(lens or ()),
            renderers=tuple(renderer or ()),
            backend=scene_renderer,
            tracking=TrackingOptions(
                board=board,
                pose=pose,
                map=map_,
                metres_per_unit=metres_per_unit,
                opentrackio=opentrackio,
                freed=freed,
                lens_table=lens_table,
                phone=PhoneOptions.of(phone, phone_camera, rig),
                delay_ms=delay,
            ),
            camera=camera,
            focus_from=tuple(focus_from or ()),
            smoothing=smooth,
            width_px=max_width,
            fps=max_rate,
            captures=captures,
            webcam=webcam,
            listening=ListeningOptions(port=port, lan=lan, interface=interface, tls=tls, tls_key=tls_key, qr=qr),
        )
    )


@app.command("board")
def board_command(
    out: Annotated[Path, typer.Option(help="Where the page goes: BOARD.pdf; beside it BOARD.json, for --board.")],
    lens: Annotated[Path | None, typer.Option(help="The lens that will see it; chooses the size of the markers by its blur.")] = None,
    near: Annotated[float, typer.Option(min=0.01, help="How near the camera will come.")] = 0.4,
    far: Annotated[float, typer.Option(min=0.01, help="How far away it will be.")] = 1.0,
    image_width: Annotated[int, typer.Option(min=64, help="Width of the camera's picture.")] = 1280,
    paper: Annotated[str, typer.Option(help="a4, a3, letter, or board: a page of the board's own size.")] = "a4",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
) -> None:
    """Print a tracking board at true size: markers large enough to be read through the lens's blur, on one paper.

    Print without scaling, and check the ruler at its foot.

    Example: mrbokeh viewfinder board --lens lens.json --near 0.5 --far 1.2 --paper a4 --out board.pdf
    """
    from mrbokeh.renderers.choose import read_lens
    from mrbokeh.system.atomic_files import refuse_existing
    from mrbokeh.tracking.charuco.board import write_board
    from viewfinder.tracking.printed_board import BoardView, plan_board, write_board_pdf

    if out.suffix.lower() != ".pdf":
        raise InputError(f"--out: expected a name that ends in .pdf, got {out}")
    for path in (out, out.with_suffix(".json")):
        refuse_existing(path, overwrite)
    # Without a lens that of a phone, to which everything on the table is nearly sharp.
    used = read_lens(lens) if lens is not None else Lens(5.0, 2.0, 2.0 / (1.0 / near + 1.0 / far), 6.4)
    plan = plan_board(BoardView(used, near, far, image_width), paper)
    say(plan.sentence)
    if plan.board is None or plan.paper is None:
        raise InputError("no paper holds a board that this lens can read: take a larger f-number, or stand farther away")
    write_board_pdf(out, plan.board, plan.paper, overwrite=overwrite)
    write_board(out.with_suffix(".json"), plan.board)
    tell(f"wrote {out} (print it at 100 %) and {out.with_suffix('.json')} (for --board)")


@app.command("calibrate-phone")
def calibrate_phone_command(
    source: Annotated[str, typer.Option(help=f"The camera. {_SOURCE_HELP}")],
    phone: Annotated[str, typer.Option(metavar="SOURCE", help="The phone's camera: whip (its browser), or as --source.")],
    phone_camera: Annotated[Path, typer.Option(help="CAMERA.json with the intrinsics of --phone.")],
    board: Annotated[Path, typer.Option(help="BOARD.json of `mrbokeh viewfinder board`, which both see.")],
    out: Annotated[Path, typer.Option(help="RIG.json to write, for --rig.")],
    camera: CameraOption = None,
    lens: Annotated[Path | None, typer.Option(help="The lens, for the intrinsics where there is no --camera.")] = None,
    pairs: Annotated[int, typer.Option(min=5, help="How many views to take.")] = 12,
    seconds: Annotated[float, typer.Option(min=1.0, help="After so long it ends with the views that there are.")] = 300.0,
    max_width: MaxWidthOption = 1280,
    port: PortOption = 8080,
    lan: LanOption = False,
    interface: InterfaceOption = None,
    tls: TlsOption = None,
    tls_key: TlsKeyOption = None,
    qr: QrOption = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace RIG.json if it exists.")] = False,
) -> None:
    """Find out where a phone sits on the camera's hot shoe; show both the board from many sides, and hold still each time.

    Stop the lens down for this: the camera too must see the board sharply.

    Example: mrbokeh viewfinder calibrate-phone --source gphoto2 --phone whip --phone-camera phone.json --lens lens.json
    --board board.json --out rig.json --lan --tls phone.pem
    """
    from viewfinder.app.calibrating import calibrate

    calibrate(
        CalibrationOptions(
            source=source,
            phone=phone,
            phone_camera=phone_camera,
            board=board,
            out=out,
            camera=camera,
            lens=lens,
            pairs=pairs,
            seconds=seconds,
            width_px=max_width,
            listening=ListeningOptions(port=port, lan=lan, interface=interface, tls=tls, tls_key=tls_key, qr=qr),
            overwrite=overwrite,
        )
    )
