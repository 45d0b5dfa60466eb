"""Options of `mrbokeh viewfinder`: packed once by the command line, passed whole to where they are used."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mrbokeh.system.errors import InputError

BACKENDS = ("auto", "wgpu", "embree")
FOCUS_BY_DEFAULT = ("hand", "tracking", "source")
FOCUS_SOURCES = (*FOCUS_BY_DEFAULT, "board")
"""The page, the tracking system, what comes with the frames, and the blur of the board, which is asked only if it is named."""


@dataclass(frozen=True)
class ListeningOptions:
    """Address that a command listens on. interface: None takes the one private one. qr: print a QR code for a network."""

    port: int = 8080
    lan: bool = False
    interface: str | None = None
    tls: Path | None = None
    tls_key: Path | None = None
    qr: bool = True

    def refuse_contradictions(self) -> None:
        """Raise InputError for an option that has no effect without another one."""
        if self.interface is not None and not self.lan:
            raise InputError(f"--interface {self.interface} is for --lan: give --lan too, or leave it out")
        if self.tls_key is not None and self.tls is None:
            raise InputError("--tls-key is for --tls CERTIFICATE: give the certificate too, or leave it out")


@dataclass(frozen=True)
class PhoneOptions:
    """Phone on the hot shoe. source: in the words of --source. camera: its intrinsics. rig: of `mrbokeh viewfinder calibrate-phone`."""

    source: str
    camera: Path
    rig: Path

    @staticmethod
    def of(source: str | None, camera: Path | None, rig: Path | None) -> "PhoneOptions | None":
        """Return the options of a phone if all three are given, None if none is; InputError for anything between."""
        if source is not None and camera is not None and rig is not None:
            return PhoneOptions(source, camera, rig)
        for word, given, made in (
            ("--phone-camera", camera, "CAMERA.json, its intrinsics"),
            ("--rig", rig, "RIG.json (make it with `mrbokeh viewfinder calibrate-phone`)"),
        ):
            if source is None and given is not None:
                raise InputError(f"{word} is for --phone: say where the phone's camera comes from, or leave it out")
            if source is not None and given is None:
                raise InputError(f"--phone needs {word} {made}")
        return None


@dataclass(frozen=True)
class TrackingOptions:
    """Ways to track the camera, of which at most one is used; a phone needs the board.

    opentrackio, freed: UDP ports; lens_table: of FreeD's encoders. metres_per_unit: of a map without a scale. delay_ms: how much later
    the camera's picture comes than the pose of a phone or a tracking system for the same moment.
    """

    board: Path | None = None
    pose: Path | None = None
    map: Path | None = None
    metres_per_unit: float | None = None
    opentrackio: int | None = None
    freed: int | None = None
    lens_table: Path | None = None
    phone: PhoneOptions | None = None
    delay_ms: float = 0.0

    @property
    def ways(self) -> list[str]:
        """Names of the ways that were chosen; a phone's board is part of the phone."""
        names = ("board", "pose", "map", "opentrackio", "freed", "phone")
        return [name for name in names if getattr(self, name) is not None and not (name == "board" and self.phone is not None)]


@dataclass(frozen=True)
class ViewfinderOptions:
    """All options of `mrbokeh viewfinder`. Exactly one of scene and layer is given."""

    source: str
    scene: Path | None = None
    layer: Path | None = None
    lenses: tuple[Path, ...] = ()
    renderers: tuple[str, ...] = ()
    backend: str = "auto"
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    camera: Path | None = None
    focus_from: tuple[str, ...] = ()
    smoothing: bool = False
    width_px: int | None = 640
    fps: float | None = None
    captures: Path = Path("captures")
    webcam: str | None = None
    listening: ListeningOptions = field(default_factory=ListeningOptions)

    def refuse_contradictions(self) -> None:
        """Raise InputError for the first contradiction, before anything is opened."""
        for sentence in (*self._wrong_in_picture(), *self._wrong_in_tracking(), *self._wrong_in_focus()):
            raise InputError(sentence)
        self.listening.refuse_contradictions()

    def _wrong_in_picture(self) -> Iterator[str]:
        if (self.scene is None) == (self.layer is None):
            yield "expected either --scene SCENE.toml or --layer RGBAZ.exr: give one of them"
        if self.backend not in BACKENDS:
            yield f"--scene-renderer: expected one of {', '.join(BACKENDS)}, got {self.backend!r}"
        if self.backend != "auto" and self.layer is not None:
            yield "--scene-renderer draws a --scene, but a --layer is drawn already: leave --scene-renderer out"
        if self.fps is not None and not self.fps > 0.0:
            yield f"--max-rate: expected a positive number of frames per second, got {self.fps:g}"

    def _wrong_in_tracking(self) -> Iterator[str]:
        tracking = self.tracking
        ways = tracking.ways
        if len(ways) > 1:
            yield f"expected one way to track the camera, got --{' and --'.join(ways)}: give one of them"
        if tracking.phone is not None and tracking.board is None:
            yield "--phone needs --board BOARD.json, the board that the phone sees"
        if tracking.phone is not None and tracking.phone.source == self.source != "whip":
            yield f"--phone and --source are both {self.source}: expected two cameras, the phone's and the one it sits on"
        if tracking.lens_table is not None and tracking.freed is None:
            yield "--lens-table is for the encoders of --freed: leave it out"
        if tracking.metres_per_unit is not None and tracking.map is None:
            yield "--metres-per-unit is the scale of a --map: leave it out"
        if tracking.metres_per_unit is not None and not tracking.metres_per_unit > 0.0:
            yield f"--metres-per-unit: expected a number above 0, got {tracking.metres_per_unit:g}"
        if tracking.delay_ms and not {"phone", "opentrackio", "freed"} & set(ways):
            yield "--delay is for poses that come from elsewhere (--phone, --opentrackio, --freed): leave it out"
        if self.smoothing and not set(ways) - {"pose"}:
            yield "--smooth needs a track: give --board, --map, --phone, --opentrackio or --freed, or leave it out"

    def _wrong_in_focus(self) -> Iterator[str]:
        for name in self.focus_from:
            if name not in FOCUS_SOURCES:
                yield f"--focus-from: expected one of {', '.join(FOCUS_SOURCES)}, got {name!r}"
        tracking = self.tracking
        if "board" in self.focus_from and tracking.board is None:
            yield "--focus-from board needs --board BOARD.json, whose blur tells the focus"
        if "tracking" in self.focus_from and tracking.freed is None and tracking.opentrackio is None:
            yield "--focus-from tracking needs a tracking system: give --opentrackio PORT or --freed PORT"
        if "tracking" in self.focus_from and tracking.freed is not None and tracking.lens_table is None:
            yield "--focus-from tracking with --freed needs --lens-table LENS.csv: FreeD sends the counts of encoders, not metres"


@dataclass(frozen=True)
class CalibrationOptions:
    """All options of `mrbokeh viewfinder calibrate-phone`. Exactly one of camera and lens gives the camera's intrinsics.

    pairs: views to take; seconds: after so long it ends with the views that there are.
    """

    source: str
    phone: str
    phone_camera: Path
    board: Path
    out: Path
    camera: Path | None = None
    lens: Path | None = None
    pairs: int = 12
    seconds: float = 300.0
    width_px: int | None = 1280
    listening: ListeningOptions = field(default_factory=ListeningOptions)
    overwrite: bool = False
