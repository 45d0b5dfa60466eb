"""Options of `mrbokeh composite` alone, in groups."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from mrbokeh.commands import _insertion_options as shared
from mrbokeh.system.errors import InputError, require_file
from mrbokeh.system.typed_numbers import numbers_in, pixels_in

NOTHING = "nothing to put into the photograph: give --object OBJ.glb, --scene SCENE.toml or --layer RGBAZ.exr"

PhotoArgument = Annotated[
    Path,
    typer.Argument(
        metavar="PHOTO",
        help="A photograph (RAW, JPEG, HEIC, TIFF, PNG, WebP, EXR, HDR), the folder of a merged focal stack, or a viewfinder's capture "
        "bundle.",
    ),
]
OutOption = Annotated[
    Path,
    typer.Option(help="The picture: .exr stays linear and holds all layers, .png and .tif are 16-bit sRGB, .jpg is 8-bit."),
]


@dataclass(frozen=True)
class PlateOptions(shared.NearOptions):
    """Options of the photograph and its depth. disparity: NEAR:FAR as typed."""

    slice_: Annotated[int | None, typer.Option("--slice", help="Which slice of the focal stack to put it into.")] = None
    all_slices: Annotated[bool, typer.Option("--all-slices", help="Put it into every slice of the stack; OUT is a new stack.")] = False
    depth: Annotated[
        Path | None,
        typer.Option(
            help="Depth of the photograph: EXR with Z, PNG or TIFF, a phone's photograph, an array (.npz) or a depth network (.onnx). "
            "Default: PHOTO's own."
        ),
    ] = None
    stereo: Annotated[
        Path | None,
        typer.Option(
            help="A second photograph of the same still scene, taken a hand's breadth beside PHOTO with the same camera: depth comes from "
            "both."
        ),
    ] = None
    baseline: Annotated[
        float | None, typer.Option(help="How far the camera moved to --stereo. Default: a guess of 0.1, and so are all metres.")
    ] = None
    rgb: Annotated[
        Path | None,
        typer.Option(
            metavar="SHARP", help="The photograph all in focus, as of another program: what blurred near things hide is taken from it."
        ),
    ] = None
    disparity: shared.DisparityOption = None
    depth_scale: Annotated[float | None, typer.Option(help="--depth holds distance: metres for each step; 0 is unknown.")] = None
    stereo_cameras: Annotated[
        str | None, typer.Option(metavar="FOCAL_PX,BASELINE_M,OFFSET_PX", help="--depth holds disparity in pixels, of these two cameras.")
    ] = None
    exact_depth: shared.ExactDepthOption = False

    def require_meant(self, photo: Path) -> None:
        """Raise InputError where options of depth contradict one another, or go without a second photograph that they are of."""
        shared.require_depth_file(self.depth)
        if self.baseline is not None and self.stereo is None:
            raise InputError(f"--baseline {self.baseline:g} says how far the camera moved to a second photograph: give that as --stereo")
        if self.baseline is not None and not 0.0 < self.baseline < math.inf:
            raise InputError(
                f"--baseline: expected metres above 0, got {self.baseline:g}: photographs from one place show no depth, move by a hand's "
                f"breadth"
            )
        if self.stereo is None:
            return
        other = {
            "--depth": self.depth,
            "--disparity": self.disparity,
            "--depth-scale": self.depth_scale,
            "--stereo-cameras": self.stereo_cameras,
        }
        given = [name for name, value in other.items() if value is not None]
        if given:
            raise InputError(f"--stereo takes depth from two photographs, and {given[0]} tells another: leave one of them out")
        if photo.is_dir():
            raise InputError(f"--stereo is the second of two photographs in files, but {photo} is a folder: leave it out")
        require_file(self.stereo, "a second photograph")


@dataclass(frozen=True)
class Standing:
    """How one object stands: at or at_pixel, and its height, as typed; turn in degrees."""

    glb: Path
    at: str | None
    at_pixel: str | None
    height: str | None
    turn: float


@dataclass(frozen=True)
class ObjectOptions:
    """Options of how each --object stands: at or at_pixel, and its height, as typed; angles in degrees."""

    object_: Annotated[
        list[Path] | None,
        typer.Option(
            "--object",
            help="GLB file to render and put in; may be given several times, each with its place. Camera, level ground, guessed focus "
            "and light are those of the first.",
        ),
    ] = None
    at: Annotated[
        list[str] | None,
        typer.Option(help="X,Y,Z in metres where the object stands: right, down, forward of the lens. Once for each --object."),
    ] = None
    at_pixel: Annotated[
        list[str] | None,
        typer.Option(
            help="X,Y of the pixel on which the object stands; without depth on level ground. Once for each --object. Without --object "
            "the layers stand there: their depth is scaled so that it is the photograph's at that pixel, which leaves them as they look."
        ),
    ] = None
    height: Annotated[
        list[str] | None,
        typer.Option(
            metavar="METRES|PIXELSpx",
            help="Height of the object in metres, or such as 120px: as long as so many pixels are where it stands. Once for all, or once "
            "for each --object. Default: as in the file, or a quarter of the picture in a photograph without depth or metres.",
        ),
    ] = None
    turn: Annotated[
        list[float] | None,
        typer.Option(
            help="Turn of the object about the vertical in degrees, clockwise from above. Once for all, or once for each --object. "
            "Default: 0, the front of the GLB against the view."
        ),
    ] = None
    pitch: Annotated[
        float | None,
        typer.Option(
            help="How far the camera looks down, in degrees. Default: as an iPhone tells, or by the ground at --at-pixel, else 0."
        ),
    ] = None
    roll: Annotated[
        float | None,
        typer.Option(
            help="How far the camera is turned clockwise about its view, in degrees: the horizon then rises to the right. Default: as an "
            "iPhone, --camera or the lines of the picture tell, else 0."
        ),
    ] = None
    camera_height: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Height of the camera above the ground, where there is no depth. Default: by the focus, or 1.5.",
        ),
    ] = None
    environment: Annotated[
        Path | None, typer.Option(help="Panorama (.hdr, .exr) that lights the --object. Default: one made of the photograph.")
    ] = None
    sun: Annotated[
        str | None,
        typer.Option(
            metavar="RIGHT,ABOVE",
            help="Where the main light comes from: degrees to the right of the view (180: from behind the camera) and above the horizon, "
            "such as -60,40. Default: where place, time and compass in the file tell, if the exposure tells of sunshine.",
        ),
    ] = None
    sun_by: Annotated[
        str | None,
        typer.Option(
            metavar="TOP:FOOT:TIP",
            help="The same by a shadow on level ground: pixels X,Y of the top and the foot of something upright, and of the tip of its "
            "shadow, such as 410,120:405,520:630,560.",
        ),
    ] = None
    exposure: Annotated[float, typer.Option(min=0.0, help="Factor on the object's light.")] = 1.0
    shadow: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Darkness of the object's shadow; 1, the default, is what its light gives.")
    ] = None
    plain: Annotated[
        bool, typer.Option("--plain", help="Guess nothing: even light, no shadow, a level camera if its file tells nothing, no grain.")
    ] = False

    @property
    def files(self) -> tuple[Path | None, ...]:
        """Input files of these options."""
        return (*(self.object_ or ()), self.environment)

    @property
    def each(self) -> tuple[Standing, ...]:
        """How each object stands, in their order."""
        glbs = self.object_ or []
        columns = (_for_each(given, len(glbs)) for given in (self.at, self.at_pixel, self.height, self.turn))
        rows = zip(glbs, *columns, strict=True)
        return tuple(Standing(glb=glb, at=at, at_pixel=px, height=height, turn=turn or 0.0) for glb, at, px, height, turn in rows)

    @property
    def pixels(self) -> list[tuple[float, float]]:
        """Pixels of --at-pixel."""
        return [typed_pixel(each) for each in self.at_pixel or ()]

    @property
    def first_px(self) -> tuple[float, float]:
        """Pixel on which the first object stands."""
        return self.pixels[0]

    def require_meant(self, photo: Path, depth: Path | None, catch: str | None) -> None:
        """Raise InputError, before anything is opened, where options contradict one another or are no numbers of their kind."""
        if self.at and self.at_pixel:
            raise InputError("--at and --at-pixel both say where the object stands: give one of them")
        self.require_places()
        of_place = ((self.at, typed_place_m), (self.at_pixel, typed_pixel), (self.height, typed_height))
        for given, typed in of_place:
            for text in given or ():
                typed(text)
        for path in self.object_ or ():
            _require_object(path)
        for light, typed_light in ((self.sun, typed_sun), (self.sun_by, typed_shadow)):
            if light is not None:
                typed_light(light)
        if self.sun and self.sun_by:
            raise InputError("--sun and --sun-by both say where the main light comes from: give one of them")
        told = f"--sun {self.sun}" if self.sun else f"--sun-by {self.sun_by}" if self.sun_by else ""
        if self.sun_by and not self.object_:
            raise InputError(f"--sun-by {self.sun_by} lights an --object: give one, or leave it out")
        if told and self.environment:
            raise InputError(
                f"{told} is a light beside what the photograph tells, which --environment replaces: a panorama has its own sun, so leave "
                f"one of them out"
            )
        if told and self.plain:
            raise InputError(f"{told} needs the light that --plain leaves out: leave one of them out")
        if self.object_ and catch == "shadow" and not (self.plain or told or self.environment):
            raise InputError(
                "--catch shadow shows shadows of lights, and the photograph tells of none: say where one is with --sun RIGHT,ABOVE"
            )
        if self.pitch is not None and not -90.0 < self.pitch < 90.0:
            raise InputError(f"--pitch: expected how far the camera looks down, between -90 and 90 degrees, got {self.pitch:g}")
        if self.roll is not None and not -90.0 < self.roll < 90.0:
            raise InputError(f"--roll: expected how far the camera is turned clockwise, between -90 and 90 degrees, got {self.roll:g}")
        if self.camera_height is not None and not 0.0 < self.camera_height < math.inf:
            raise InputError(f"--camera-height: expected metres above 0, got {self.camera_height:g}")
        if self.camera_height is not None and (depth is not None or photo.is_dir() or not self.at_pixel or self.plain):
            raise InputError(_NO_USE_OF_HEIGHT.format(self.camera_height))

    def require_places(self) -> None:
        """Raise InputError unless there is a place for each object, and a height and a turn for each or one for all."""
        if self.object_ and not self.at and not self.at_pixel:
            raise InputError("where does the object stand? Give --at X,Y,Z in metres, or --at-pixel X,Y")
        count = max(1, len(self.object_ or ()))
        for name, given in (("at", self.at), ("at-pixel", self.at_pixel), ("height", self.height), ("turn", self.turn)):
            or_one = name in ("height", "turn")
            if given and len(given) != count and not (or_one and len(given) == 1):
                expected = f"{count}, one for each --object" if count > 1 else "one"
                raise InputError(f"--{name}: expected {expected}{', or one for all' * (or_one and count > 1)}, got {len(given)}")

    def require_no_depth(self) -> None:
        """Raise InputError where an option is given that only a photograph without depth needs."""
        if self.camera_height is not None:
            raise InputError(_NO_USE_OF_HEIGHT.format(self.camera_height))


_NO_USE_OF_HEIGHT = (
    "--camera-height {:g} tells how far away --at-pixel is where there is no depth: leave it out with depth, a stack, --plain or --at"
)


def _for_each(given: Sequence[Any] | None, count: int) -> Sequence[Any]:
    """Return a value for each of the objects: those given, the only one for all, or None."""
    return [None] * count if not given else [*given] * count if len(given) == 1 else given


def _require_object(path: Path) -> None:
    """Raise InputError where a file is surely no 3D object."""
    require_file(path, "a 3D object (.glb, .gltf)")
    with path.open("rb") as file:
        begins = file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    if not begins.startswith((b"glTF", b"{")):
        raise InputError(f"--object {path} is no 3D object: expected a .glb or .gltf file; a rendered picture goes in as --layer")


def typed_place_m(text: str) -> tuple[float, float, float]:
    """Return X,Y,Z of --at in metres."""
    x_m, y_m, z_m = numbers_in(text, "--at expects 3 numbers with commas between", (3,))
    if not z_m > 0.0:
        raise InputError(f"--at: expected a place in front of the lens, with Z above 0 m, got {text!r}")
    return x_m, y_m, z_m


def typed_pixel(text: str) -> tuple[float, float]:
    """Return X,Y of --at-pixel."""
    x_px, y_px = numbers_in(text, "--at-pixel expects 2 numbers with commas between", (2,))
    return x_px, y_px


def typed_sun(text: str) -> tuple[float, float]:
    """Return degrees to the right and above the horizon of --sun."""
    right_deg, above_deg = numbers_in(text, "--sun expects degrees to the right and above the horizon, such as -60,40", (2,))
    if not 0.0 < above_deg <= 90.0 or abs(right_deg) > 360.0:
        raise InputError(
            f"--sun: expected RIGHT,ABOVE in degrees, an azimuth of -360 to 360 to the right of the view and an elevation above 0 and up "
            f"to 90 over the horizon, got {text!r}"
        )
    return right_deg, above_deg


def typed_shadow(text: str) -> tuple[tuple[float, float], ...]:
    """Return three pixels of --sun-by: top, foot, and tip of the shadow."""
    return pixels_in(text, "--sun-by expects three pixels X,Y with colons between, such as 410,120:405,520:630,560", 3)


def typed_height(text: str) -> tuple[float, bool]:
    """Return the number of --height, and whether it counts pixels."""
    try:
        number = float(text.removesuffix("px"))
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise InputError(f"--height: expected metres above 0 such as 0.1, or pixels such as 120px, got {text!r}")
    return number, text.endswith("px")


@dataclass(frozen=True)
class RenderingOptions(shared.RenderingOptions):
    """Options of rendering in a photograph. time: of the animations, in seconds."""

    time: Annotated[float, typer.Option(help="Second of the animations that is shown.")] = 0.0

    @property
    def of_photograph(self) -> "RenderingOptions":
        """Return these options for one picture, whose objects the exact renderer draws unless another is named."""
        return replace(self, scene_renderer="embree") if self.scene_renderer == "auto" else self


@dataclass(frozen=True)
class LensOptions:
    """Options of the lens. focus: distance of the photograph in metres."""

    lens: Annotated[Path | None, typer.Option(help=f"{shared.ANY_LENS}. Default: what the photograph tells.")] = None
    focus: Annotated[float | None, typer.Option(help="Focus distance of the photograph in metres.")] = None
    focus_at: shared.FocusAtOption = None
    renderer: Annotated[str | None, typer.Option("--renderer", help=shared.ANY_RENDERER)] = None


@dataclass(frozen=True)
class ResultOptions:
    """Options of OUT and of files beside it."""

    preview: Annotated[
        bool,
        typer.Option(
            "--preview", help="OUT is small, with the ground in metres, a box around each --object, its distance, size and blur: to try."
        ),
    ] = False
    save_layer: Annotated[Path | None, typer.Option(help="Also write the blurred virtual layer (EXR with alpha).")] = None
    save_deep: Annotated[
        Path | None, typer.Option(metavar="FILE.exr", help="Also write the sharp virtual layers as a deep EXR, one sample per layer.")
    ] = None
    overwrite: shared.OverwriteOption = False

    def require_meant(self, out: Path, *, only_object: bool, all_slices: bool) -> None:
        """Raise InputError for a preview of something else than one object in one picture for the screen."""
        from mrbokeh.images.image_io import require_suffix

        if not self.preview:
            return
        require_suffix(out, (".png", ".jpg", ".jpeg"), "--out of a --preview")
        if not only_object or all_slices or self.save_layer is not None or self.save_deep is not None:
            raise InputError(
                "--preview shows where an --object stands: give that, and no --layer, --all-slices, --save-layer or --save-deep"
            )


_WITHOUT_MATTE = ("front", "matte")


@dataclass(frozen=True)
class CompositeOptions:
    """Options of one run of `mrbokeh composite`, in its groups."""

    photo: PhotoArgument
    taken: PlateOptions = field(default_factory=PlateOptions)
    virtual: shared.VirtualOptions = field(default_factory=shared.VirtualOptions)
    standing: ObjectOptions = field(default_factory=ObjectOptions)
    rendering: RenderingOptions = field(default_factory=RenderingOptions)
    look: shared.LookGroup = field(default_factory=shared.LookGroup)
    optics: LensOptions = field(default_factory=LensOptions)
    facts: shared.LensFacts = field(default_factory=shared.LensFacts)
    colour: shared.ColourOptions = field(default_factory=shared.ColourOptions)
    result: ResultOptions = field(default_factory=ResultOptions)

    @property
    def read(self) -> tuple[Path | None, ...]:
        """Input files of these options."""
        of_plate = (self.photo, self.taken.depth, self.taken.stereo, self.taken.rgb, self.taken.matte)
        return (*of_plate, *self.virtual.files, *self.standing.files, self.rendering.distortion, self.optics.lens)

    @property
    def guesses_ground(self) -> bool:
        """Whether an object stands on a pixel of a photograph in a file, and what is not told of that may be guessed."""
        standing = self.standing
        return bool(standing.object_) and bool(standing.at_pixel) and not self.photo.is_dir() and not standing.plain

    def require_meant(self, out: Path) -> None:
        """Raise InputError, before anything is opened, where options contradict one another, or a file that is needed is missing."""
        from mrbokeh.compositing.choose import insertion_of
        from mrbokeh.scene.gltf.surfaces import open_gltf
        from mrbokeh.stacks.capture_bundle import is_bundle

        taken, virtual, standing = self.taken, self.virtual, self.standing
        if taken.all_slices:
            self._require_options_of_stacks()
        taken.require_meant(self.photo)
        standing.require_meant(self.photo, taken.depth or taken.stereo, self.rendering.catch)
        shared.require_one_focus(focus=self.optics.focus, focus_at=self.optics.focus_at)
        if taken.matte is not None and virtual.mode in _WITHOUT_MATTE:
            raise InputError(
                f"--matte says what stands in front, which the mode {virtual.mode} does not look at: leave --mode out, or --matte"
            )
        if virtual.mode is not None:
            insertion_of(virtual.mode, taken.near_distance)
        for glb in standing.object_ or ():
            open_gltf(glb)
        self.result.require_meant(out, only_object=bool(standing.object_) and not virtual.layer, all_slices=taken.all_slices)
        if virtual.camera is not None and virtual.scene is None and not standing.object_:
            raise InputError(f"--camera {virtual.camera} is for a --scene or an --object: give one, or leave it out")
        if not (standing.object_ or virtual.layer or virtual.scene is not None or is_bundle(self.photo)):
            raise InputError(NOTHING)

    def _require_options_of_stacks(self) -> None:
        """Raise InputError if an option is given that is of one picture, and that --all-slices would not follow."""
        one_picture = (
            (
                self.taken,
                ("slice_", "depth", "stereo", "baseline", "rgb", "disparity", "depth_scale", "stereo_cameras", "matte", "near_distance"),
            ),
            (self.optics, ("focus", "focus_at")),
            (self.look, tuple(vars(self.look))),
            (self.colour, ("input_space", "output_space")),
            (self.result, ("save_layer", "save_deep")),
        )
        given = [name for group, names in one_picture for name in names if getattr(group, name) != getattr(type(group)(), name)]
        if given:
            told = ", ".join(f"--{name.rstrip('_').replace('_', '-')}" for name in given)
            raise InputError(
                f"--all-slices writes every slice with the stack's own depth, focus and colours, but got {told}, of one picture: "
                f"leave that out, or leave --all-slices out and choose a --slice"
            )

    def scaled(self, whole_px: tuple[int, int], small_px: tuple[int, int]) -> "CompositeOptions":
        """Return the options for the photograph made smaller, by its width and height before and after: all that counts pixels follows."""
        if whole_px == small_px:
            return self
        factor, height, at_pixel = small_px[1] / whole_px[1], self.standing.height, self.standing.at_pixel
        height = height and [f"{factor * typed_height(each)[0]:.9g}px" if each.endswith("px") else each for each in height]
        at_pixel = at_pixel and [_scaled(each, whole_px, small_px) for each in at_pixel]
        standing = replace(self.standing, at_pixel=at_pixel, height=height)
        focus_at = self.optics.focus_at and _scaled(self.optics.focus_at, whole_px, small_px)
        focus_at = focus_at and ",".join(str(int(float(each))) for each in focus_at.split(","))
        return replace(self, standing=standing, optics=replace(self.optics, focus_at=focus_at))


_INSIDE = 1e-3


def _scaled(pair: str, whole_px: tuple[int, int], small_px: tuple[int, int]) -> str:
    """Return a pixel of the whole as that of the small picture, within it."""
    places = zip(pair.split(","), whole_px, small_px, strict=False)
    return ",".join(f"{min(float(each) * small / whole, small - _INSIDE):.9g}" for each, whole, small in places)
