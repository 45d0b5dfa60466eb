"""Options that `mrbokeh composite` and `mrbokeh video` have in common: what is inserted, how it is rendered, colour spaces, look."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import numbers_in

if TYPE_CHECKING:
    import numpy as np

    from mrbokeh.images.color_management import NamedSpace
    from mrbokeh.optics.lens import Lens
    from mrbokeh.renderers.base import Renderer
    from mrbokeh.scene.moving_layers import ShutterTiming
    from mrbokeh.scene.staging.filming import Filming


ANY_LENS = "LENS.json, a name of `mrbokeh lens list`, a bank of PSFs (its folder) or a network (.onnx)"
ANY_RENDERER = (
    "polygon, low-rank, scatter, laplacian, a network (.onnx) or a bank (folder). Default: --lens if a network or bank, else polygon."
)
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what exists.")]


@dataclass(frozen=True)
class NearOptions:
    """Options of what stands in front of virtual things. near_distance: of what the matte shows, in metres."""

    matte: Annotated[
        Path | None,
        typer.Option(
            metavar="MATTE.png",
            help="White where something real stands in front, as soft as the photograph shows it; transparent where depth is to tell. "
            "Of a clip also matte.%04d.png.",
        ),
    ] = None
    near_distance: Annotated[
        float | None,
        typer.Option(metavar="METRES", help="How far what --matte shows is, which is sharp then; the lens blurs it."),
    ] = None


@dataclass(frozen=True)
class VirtualOptions:
    """Layers of other renderers and a scene, and how they go in."""

    layer: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RGBAZ.exr",
            help="All-in-focus virtual layer: EXR with R, G, B, A (linear, premultiplied) and Z in metres, of a clip also "
            "layer.%04d.exr; may be given several times, front first. Deep EXR goes among all others by depth.",
        ),
    ] = None
    objects: Annotated[str | None, typer.Option(metavar="NAME,NAME", help="Only these objects of the layers, by their Cryptomatte.")] = None
    scene: Annotated[
        Path | None, typer.Option(metavar="SCENE.toml", help="Scene file with objects, lights and shadow, which is rendered.")
    ] = None
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="CAMERA",
            help="For --scene: a fixed camera (JSON) or a track (JSON, .chan, nerfstudio, COLMAP, OpenTrackIO); in a photograph by "
            "default one that looks along z from the origin. For an --object in a photograph: the camera of `mrbokeh capture solve`.",
        ),
    ] = None
    mode: Annotated[
        str | None,
        typer.Option(
            help="How layers go in: front, over (by depth), matte, between (behind blurred near things) or rerender. Default: the best "
            "that what is known of the plate allows."
        ),
    ] = None

    @property
    def files(self) -> tuple[Path | None, ...]:
        """Input files of these options."""
        return (*(self.layer or ()), self.scene, self.camera)

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names in --objects. Raises InputError if there is no layer to take them from."""
        if self.objects is not None and not self.layer:
            raise InputError(f"--objects {self.objects} are taken out of layers: give --layer RENDER.exr with a Cryptomatte")
        return () if self.objects is None else tuple(self.objects.split(","))


@dataclass(frozen=True)
class RenderingOptions:
    """Options of rendering --scene and --object."""

    scene_renderer: Annotated[
        str,
        typer.Option(help="Who renders objects and scenes: embree, wgpu, mitsuba, or auto (embree in a photograph, else a graphics card)."),
    ] = "auto"
    paths: Annotated[int, typer.Option(min=1, help="Paths per pixel of mitsuba.")] = 64
    catch: Annotated[
        str | None,
        typer.Option(
            help="What the ground under them catches: shadow, of lights and as dark as is told, or light, all that they change there (also "
            "reflections, with mitsuba). Default: light of an --object, else shadow."
        ),
    ] = None
    distortion: Annotated[
        Path | None,
        typer.Option(metavar="DISTORTION.json", help="How the lens bends straight lines: what is rendered is bent alike."),
    ] = None

    def filming(self, shutter: "ShutterTiming | None" = None) -> "Filming":
        """Return the render settings. shutter: None for no motion blur."""
        from mrbokeh.distortion.distortion import read_distortion
        from mrbokeh.scene.staging.filming import Filming

        distortion = read_distortion(self.distortion)
        return Filming(self.scene_renderer, self.paths, catches=self.catch or "shadow", distortion=distortion, shutter=shutter)


DisparityOption = Annotated[
    str | None, typer.Option(metavar="NEAR:FAR", help="--depth is even in 1/distance, largest number at NEAR, 0 at FAR metres.")
]
ExactDepthOption = Annotated[
    bool,
    typer.Option(
        "--exact-depth",
        help="Depth is exact, as of a render. By default holes, soft and misplaced edges of depth are mended by the picture's colours.",
    ),
]
FocusAtOption = Annotated[str | None, typer.Option(help="Focus on pixel X,Y, or on what lies within R pixels of it: X,Y,R.")]


def focused_at_pixel(lens: "Lens", depth_m: "np.ndarray | None", place: str) -> "Lens":
    """Return the lens focused on what the depth has at a place, X,Y or X,Y,R as typed. Raises InputError without depth."""
    if depth_m is None:
        raise InputError("--focus-at looks up how far away the place is, but there is no depth: give --depth, or --focus METRES")
    x_px, y_px, *radius_px = typed_place(place)
    return lens.focused_on(depth_m, x_px + 0.5, y_px + 0.5, float(*radius_px))


def typed_place(text: str) -> tuple[int, ...]:
    """Return X,Y or X,Y,R of --focus-at."""
    return numbers_in(text, "--focus-at: expected X,Y or X,Y,RADIUS in whole pixels", (2, 3), number=int)


def require_depth_file(depth: Path | None) -> None:
    """Raise InputError where --depth names a file that surely holds no depth, such as a 3D object."""
    import cv2

    from mrbokeh.images.image_io import ENCODED_SUFFIXES

    if depth is None or not depth.is_file() or depth.suffix.lower() in (*ENCODED_SUFFIXES, ".exr", ".npz", ".npy", ".onnx"):
        return
    if not cv2.haveImageReader(str(depth)):
        raise InputError(
            f"--depth {depth}: expected an EXR with Z, a PNG or TIFF, an array (.npz), a phone's photograph (.jpg, .heic) or a depth "
            f"network (.onnx), got {depth.suffix or 'a file without suffix'}"
        )


def near_far_of(disparity: str | None, depth: Path | None) -> tuple[float, float] | None:
    """Return NEAR and FAR of --disparity in metres, or None. depth: the file whose numbers it explains; None is refused."""
    from mrbokeh.depth.depth_map import parse_near_far

    if disparity is not None and depth is None:
        raise InputError(f"--disparity {disparity} says what the numbers of a --depth file mean: give that too, or leave --disparity out")
    return None if disparity is None else parse_near_far(disparity)


def in_degrees(shutter: float | None) -> float | None:
    """Return a shutter angle. Raises InputError if it looks like the share of the frame's time."""
    if shutter is not None and 0.0 < shutter <= 1.0:
        raise InputError(f"--shutter counts degrees, not shares of a frame's time: for {shutter:g} of it give {360.0 * shutter:g}")
    return shutter


def require_one_focus(**given: object) -> None:
    """Raise InputError if more than one of these options says where the focus lies."""
    named = [f"--{name.replace('_', '-')}" for name, value in given.items() if value is not None]
    if len(named) > 1:
        raise InputError(f"{' and '.join(named)} say where the focus lies: give one of them, not both")


@dataclass(frozen=True)
class LensFacts:
    """Facts of the lens in place of those of --lens or of the photograph; None leaves them."""

    focal_length_mm: Annotated[float | None, typer.Option("--focal-length", metavar="MM", help="Focal length in mm.")] = None
    f_number: Annotated[float | None, typer.Option(metavar="N", help="f-number.")] = None
    sensor_width_mm: Annotated[float | None, typer.Option("--sensor-width", metavar="MM", help="Sensor width in mm.")] = None

    @property
    def given(self) -> dict[str, float]:
        """Facts that were given, by their names in `Lens` and `Photograph`."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def on(self, lens: "Lens | None", renderer: "Renderer | None" = None) -> "Lens":
        """Return the lens with these facts; without one the lens of `Lens.default`. Raises InputError if a network brought the lens."""
        from mrbokeh.optics.lens import Lens
        from mrbokeh.renderers.onnx_network import OnnxNetwork

        if self.given and isinstance(renderer, OnnxNetwork):
            raise InputError("a network blurs as the lens that it learned: leave --focal-length, --f-number and --sensor-width out")
        return (lens or Lens.default()).stating(self.given)


@dataclass(frozen=True)
class ColourOptions:
    """Colour spaces of OpenColorIO, by name; None is as files state, and linear Rec.709 or sRGB out."""

    input_space: Annotated[str | None, typer.Option(help="OpenColorIO space of the plate's numbers, such as ACEScg or 'ARRI LogC4'.")] = (
        None
    )
    output_space: Annotated[str | None, typer.Option(help="OpenColorIO space of OUT, of its layers too, such as ACEScg.")] = None
    ocio: Annotated[str, typer.Option(metavar="CONFIG", help="OpenColorIO configuration: aces, aces-cg or a file.")] = "aces"

    def __post_init__(self) -> None:
        if self.ocio != "aces" and self.input_space is None and self.output_space is None:
            raise InputError(f"--ocio {self.ocio} has no use by itself: say --input-space or --output-space, or leave it out")

    @property
    def of_plate(self) -> "NamedSpace | None":
        return self._space(self.input_space)

    @property
    def of_result(self) -> "NamedSpace | None":
        return self._space(self.output_space)

    def _space(self, name: str | None) -> "NamedSpace | None":
        from mrbokeh.images.color_management import NamedSpace

        return None if name is None else NamedSpace.of(name, self.ocio)


if TYPE_CHECKING:
    from mrbokeh.compositing.plate_look.finishing import LookOptions


@dataclass(frozen=True)
class LookGroup:
    """Options that make virtual light look photographed: texts as typed, see `mrbokeh.compositing.plate_look.finishing.LookOptions`."""

    match_grey: Annotated[str | None, typer.Option(metavar="X,Y[,R]", help="A grey card in the plate sets exposure and white balance.")] = (
        None
    )
    grey_value: Annotated[float, typer.Option(help="What the card reflects.")] = 0.18
    match_exposure: Annotated[
        Path | None,
        typer.Option(
            metavar="PHOTO", help="Photograph of which the virtual light was made: exposures are matched, by what both state of theirs."
        ),
    ] = None
    plate_exposure: Annotated[
        str | None,
        typer.Option(
            metavar="SECONDS,ISO,F",
            help="Exposure of the plate for --match-exposure, such as 1/50,400,2.8, where its file states none: any video.",
        ),
    ] = None
    match_white: Annotated[
        float | None,
        typer.Option(
            metavar="KELVIN", help="Light that the plate was balanced for: above 6504 virtual light gets warmer, below it cooler."
        ),
    ] = None
    match_black: Annotated[str | None, typer.Option(metavar="auto|off|X,Y[,R]", help="Virtual blacks are lifted to the plate's.")] = None
    vignetting: Annotated[str | None, typer.Option(metavar="auto|K1,K2,K3|FLAT.png", help="The lens darkens virtual light too.")] = None
    grain: Annotated[str | None, typer.Option(metavar="auto|off|FILE", help="Grain as measured in the plate, on virtual light.")] = None
    light_wrap: Annotated[str | None, typer.Option(metavar="STRENGTH[,SIGMA]", help="Light of the plate over virtual edges.")] = None
    seed: Annotated[int, typer.Option(min=0, help="Of the grain.")] = 0

    @property
    def wanted(self) -> "LookOptions":
        from mrbokeh.compositing.plate_look.finishing import LookOptions

        rest = {name: value for name, value in vars(self).items() if name != "match_white"}
        return LookOptions(match_white_k=self.match_white, **rest)
