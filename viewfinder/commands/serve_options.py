"""What `mrbokeh viewfinder` was asked for, and which wishes contradict one another."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mrbokeh.system.errors import InputError
from viewfinder.app.focus_choice import FOCUS_SOURCES
from viewfinder.app.tracking_choice import TrackingChoice
from viewfinder.commands.listening import ListeningOptions

BACKENDS = ("auto", "wgpu", "embree")


@dataclass(frozen=True)
class ServeOptions:
    """As on the command line (viewfinder/cli.py). Exactly one of scene and layer."""

    source: str
    scene: Path | None = None
    layer: Path | None = None
    lenses: tuple[Path, ...] = ()
    renderers: tuple[str, ...] = ()
    psf: Path | None = None
    backend: str = "auto"
    tracking: TrackingChoice = field(default_factory=TrackingChoice)
    camera: Path | None = None
    focus_from: tuple[str, ...] = ()
    smoothing: bool = False
    width_px: int | None = 640
    fps: float | None = None
    captures: Path = Path("captures")
    webcam: str | None = None
    listening: ListeningOptions = field(default_factory=ListeningOptions)


def refuse_contradictions(options: ServeOptions) -> None:
    """InputError with the first of them, before anything is opened."""
    for sentence in (*_of_picture(options), *_of_tracking(options), *_of_focus(options)):
        raise InputError(sentence)
    options.listening.refuse_contradictions()


def _of_picture(options: ServeOptions) -> Iterator[str]:
    if (options.scene is None) == (options.layer is None):
        yield "expected either --scene SCENE.toml or --layer RGBAZ.exr: give one of them"
    if options.backend not in BACKENDS:
        yield f"--backend: expected one of {', '.join(BACKENDS)}, got {options.backend!r}"
    if options.backend != "auto" and options.layer is not None:
        yield "--backend draws a --scene, but a --layer is drawn already: leave --backend out"
    if options.fps is not None and not options.fps > 0.0:
        yield f"--fps: expected a positive number of frames per second, got {options.fps:g}"


def _of_tracking(options: ServeOptions) -> Iterator[str]:
    choice = options.tracking
    ways = choice.ways
    if len(ways) > 1:
        yield f"expected one way to track the camera, got --{' and --'.join(ways)}: give one of them"
    if choice.phone is not None and choice.board is None:
        yield "--phone needs --board BOARD.json, the board that the phone sees"
    if choice.phone is not None and choice.phone.source == options.source != "whip":
        yield f"--phone and --source are both {options.source}: expected two cameras, the phone's and the one it sits on"
    if choice.lens_table is not None and choice.freed is None:
        yield "--lens-table is for the encoders of --freed: leave it out"
    if choice.metres_per_unit is not None and choice.map is None:
        yield "--metres-per-unit is the scale of a --map: leave it out"
    if choice.metres_per_unit is not None and not choice.metres_per_unit > 0.0:
        yield f"--metres-per-unit: expected a number above 0, got {choice.metres_per_unit:g}"
    if choice.delay_ms and not {"phone", "opentrackio", "freed"} & set(ways):
        yield "--delay-ms is for poses that come from elsewhere (--phone, --opentrackio, --freed): leave it out"
    if options.smoothing and not set(ways) - {"pose"}:
        yield "--smoothing needs a track: give --board, --map, --phone, --opentrackio or --freed, or leave it out"


def _of_focus(options: ServeOptions) -> Iterator[str]:
    for name in options.focus_from:
        if name not in FOCUS_SOURCES:
            yield f"--focus-from: expected one of {', '.join(FOCUS_SOURCES)}, got {name!r}"
    choice = options.tracking
    if "board" in options.focus_from and choice.board is None:
        yield "--focus-from board needs --board BOARD.json, whose blur tells the focus"
    if "tracking" in options.focus_from and choice.freed is None and choice.opentrackio is None:
        yield "--focus-from tracking needs a tracking system: give --opentrackio PORT or --freed PORT"
    if "tracking" in options.focus_from and choice.freed is not None and choice.lens_table is None:
        yield "--focus-from tracking with --freed needs --lens-table LENS.csv: FreeD sends the counts of encoders, not metres"
