"""Finishing of virtual light so that it looks photographed, in the order in which a camera does it.

1. Gain of the colour match: light becomes the photograph's numbers. It belongs before the blur, but blur sums light with weights
   of sum 1 and so commutes with it; after it, it costs one multiplication and the blurred layer can be matched anew without blurring.
2. Vignetting: the share of light that the lens sends to a place of the sensor, so after the blur has brought it there.
3. Black: glare and offset lie over everything evenly, so they do not fall off towards the corners.
4. Light wrap: light of the photograph, which has 1 to 3 in it already.
5. Grain: made by the sensor from all light that arrives.
6. Compression: made of the finished picture, so last, with the same blocks, tables and halved colour as a JPEG photograph's.
"""

import io
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate import Inserted, Plate
from mrbokeh.compositing.plate_look.colour_match import (
    GREY_CARD,
    ColourMatch,
    PixelBox,
    Triple,
    darkest_black,
    grey_card_match,
    patch_colour,
    triple_of,
)
from mrbokeh.compositing.plate_look.exposure_match import Exposure, matched_exposure, stated_exposure, white_balance_gain
from mrbokeh.compositing.plate_look.grain import Grain, GrainDraw, add_grain_to, measured_grain, measured_grain_of_pair, read_grain
from mrbokeh.compositing.plate_look.noise_measurement import NoiseLevel
from mrbokeh.compositing.plate_look.vignetting import RadialFalloff, Vignetting, darkened, falloff_at, falloff_of_photo, read_flat_field
from mrbokeh.images.color import srgb_codes, srgb_to_linear
from mrbokeh.images.exif import header_of, oriented_as_stored, stored_orientation
from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import Box, lit_box
from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import numbers_in

_BLOCK_PX = 16
"""Sides of the blocks whose colour is halved in both directions; all others fit into them."""
_SIGMAS = 3
_LEAST_PX, _SURELY_BLACK, _MOST_GRAIN, _SHOWN = 64, 0.02, 0.015, np.linspace(0.1, 0.8, 8, dtype=np.float32)
"""Sides of a picture that tells its black; the lightest black that is surely one; standard deviation of strong grain on a screen of 0 to 1,
and the levels there at which it is looked at.
"""

Picture = Float32[np.ndarray, "height width 3"]
AUTO, OFF = "auto", "off"
NO_BLACK: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class JpegCompression:
    """How a photograph was compressed. tables: of quantization, 64 numbers each. subsampling: of colour, as Pillow counts it."""

    tables: dict[int, list[int]]
    subsampling: int
    orientation: int

    @classmethod
    def of(cls, photo: Path) -> "JpegCompression | None":
        """Return how a file was compressed; None if it is no JPEG in colours, or of a kind that Pillow does not write."""
        from PIL import JpegImagePlugin, UnidentifiedImageError

        try:
            with header_of(photo) as picture:
                if not isinstance(picture, JpegImagePlugin.JpegImageFile) or picture.mode != "RGB":
                    return None
                subsampling = JpegImagePlugin.get_sampling(picture)
                tables = {number: list(table) for number, table in picture.quantization.items()}
        except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
            return None
        return cls(tables, subsampling, stored_orientation(photo)) if subsampling in (0, 1, 2) else None

    def compressed(self, inserted: Inserted) -> Inserted:
        """Return the picture with its virtual part compressed together with the photograph around it; what no code stands for stays.

        The photograph's own pixels stay too: they were compressed already.
        """
        from PIL import Image

        changed = inserted.virtual.rgb.copy()
        alpha, light, photo = (oriented_as_stored(each, self.orientation) for each in (inserted.virtual.alpha, changed, inserted.photo_rgb))
        rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
        if not len(rows):
            return inserted
        part = tuple(slice(each[0] // _BLOCK_PX * _BLOCK_PX, (each[-1] // _BLOCK_PX + 1) * _BLOCK_PX) for each in (rows, columns))
        whole = np.ascontiguousarray(photo[part] + light[part])
        stream = io.BytesIO()
        Image.fromarray(srgb_codes(whole, np.uint8)).save(stream, "JPEG", qtables=self.tables, subsampling=self.subsampling)
        decoded = srgb_to_linear(np.asarray(Image.open(stream), np.float32) / np.float32(255.0))
        virtual = (alpha[part] > 0.0)[..., None] & (whole >= 0.0) & (whole <= 1.0)
        light[part] = np.where(virtual, decoded - photo[part], light[part])
        return replace(inserted, virtual=replace(inserted.virtual, rgb=changed))


@dataclass(frozen=True)
class LightWrap:
    """Light of the photograph that spills over an object's soft edge. strength: 0 to 1. sigma_px: radius of the photograph's mean.

    A habit of compositors, off by default: a lens's own flare does it, and the blurred edge shows the scene behind it already. With B
    the mean light of the photograph around a pixel (of what is visible, by a Gaussian), a pixel of coverage a gets strength * a * (1 -
    a) * B on top: of the light a B that the object hides there, the share strength * (1 - a). So the energy added to a picture is
    strength times the sum of a (1 - a) B, at most a quarter of B in any pixel, and nothing where a is 0 or 1.
    """

    strength: float
    sigma_px: float = 8.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.strength <= 1.0 or not 0.0 < self.sigma_px < float("inf"):
            raise InputError(
                f"expected a light wrap of strength 0 to 1 and a radius above 0 px, got {self.strength:g} and {self.sigma_px:g} px"
            )

    @property
    def reach_px(self) -> int:
        return int(np.ceil(_SIGMAS * self.sigma_px))

    def wrapped(self, layer: Layer, photo_rgb: Float32[np.ndarray, "height width 3"]) -> Layer:
        """Add the spilled light. photo_rgb: what is left of the photograph, (1 - a) P. Within reach_px of a border the mean misses what
        lies beyond.
        """
        free = 1.0 - layer.alpha
        visible, weight = self._blurred(photo_rgb), self._blurred(free)
        around = visible / np.maximum(weight, 1e-6)[..., None]
        share = np.float32(self.strength) * layer.alpha * free
        return replace(layer, rgb=layer.rgb + share[..., None] * around)

    def _blurred(self, values: np.ndarray) -> np.ndarray:
        import cv2

        side = 2 * self.reach_px + 1
        return cv2.GaussianBlur(values, (side, side), self.sigma_px, borderType=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class Finishing:
    """Steps of finishing; None leaves a step out."""

    colour: ColourMatch | None = None
    vignetting: Vignetting | None = None
    grain: Grain | None = None
    light_wrap: LightWrap | None = None
    compression: JpegCompression | None = None

    @property
    def is_nothing(self) -> bool:
        colour = self.colour is None or self.colour.is_nothing
        grain = self.grain is None or self.grain.is_nothing
        bare = self.vignetting is None and self.compression is None
        return colour and grain and bare and (self.light_wrap is None or self.light_wrap.strength == 0.0)

    def light_before(self, rgb: Picture) -> Picture:
        """Return the photograph's light as layers must have it that give it back: colour match and vignetting then make it what it is."""
        if self.vignetting is not None:
            rgb = rgb / self.vignetting.gain(Box(0, rgb.shape[0], 0, rgb.shape[1]), rgb.shape[:2])
        gain = (1.0, 1.0, 1.0) if self.colour is None else self.colour.gain
        return rgb if gain == (1.0, 1.0, 1.0) else rgb / np.array(gain, np.float32)


def finished(inserted: Inserted, plate: Plate, finishing: Finishing, frame: int = 0) -> Inserted:
    """The virtual part finished; the photograph's part stays as it is, and so do all pixels without virtual coverage and light.

    frame: its number in a video, for the draw of the grain. Extra channels and depth of the layer are kept. A Finishing that
    does nothing gives back what came.
    """
    if plate.rgb.shape != inserted.photo_rgb.shape:
        raise InputError(f"expected the plate that was inserted into, of {inserted.photo_rgb.shape}, got one of {plate.rgb.shape}")
    if finishing.is_nothing:
        return inserted
    touched, frame_px = lit_box(replace(inserted.virtual, extra={})), plate.rgb.shape[:2]
    if touched.is_empty:
        return inserted
    box = touched if finishing.light_wrap is None else touched.grown(finishing.light_wrap.reach_px).within(frame_px)
    photo_rgb = box.of(inserted.photo_rgb)
    part = _lit(inserted.virtual, photo_rgb, finishing, box)
    light = np.array(part.rgb)
    if finishing.grain is not None and not finishing.grain.is_nothing:
        draw = GrainDraw(finishing.grain, frame, box.origin_px)
        add_grain_to(light, part.alpha, photo_rgb, box.of(plate.rgb), draw)
    rgb = inserted.virtual.rgb.copy()
    box.of(rgb)[...] = light
    done = replace(inserted, virtual=replace(inserted.virtual, rgb=rgb))
    return done if finishing.compression is None else finishing.compression.compressed(done)


def _lit(layer: Layer, photo_rgb: np.ndarray, finishing: Finishing, box: Box) -> Layer:
    """Steps 1 to 4 on one part of the frame."""
    frame_px, colour = layer.alpha.shape, finishing.colour or ColourMatch()
    layer = colour.gained(Layer(box.of(layer.rgb), box.of(layer.alpha), box.of(layer.depth_m)))
    if finishing.vignetting is not None:
        layer = darkened(layer, finishing.vignetting.gain(box, frame_px))
    layer = colour.lifted(layer)
    return layer if finishing.light_wrap is None else finishing.light_wrap.wrapped(layer, photo_rgb)


@dataclass(frozen=True)
class LookOptions:
    """Texts as typed; None or "off" leaves a step out.

    match_grey: "X,Y[,RADIUS]" of a card; grey_value: its reflectance, or what the renderer gives it. match_exposure: the photograph that
    the virtual light was taken from; plate_exposure: "SECONDS,ISO,F-NUMBER" of the plate, in place of what it states. match_white_k: the
    temperature that the plate was balanced for. match_black: "auto" or "X,Y[,RADIUS]". vignetting: "auto" (lensfun), "K1,K2,K3" or a
    picture of an even surface. grain: "auto" or a grain file. light_wrap: "STRENGTH[,SIGMA]".
    """

    match_grey: str | None = None
    grey_value: float = GREY_CARD
    match_exposure: Path | None = None
    match_white_k: float | None = None
    match_black: str | None = None
    vignetting: str | None = None
    grain: str | None = None
    light_wrap: str | None = None
    seed: int = 0
    plate_exposure: str | None = None


def finishing_of(options: LookOptions, plate_rgb: Picture, photo: Path | None = None, next_rgb: Picture | None = None) -> Finishing:
    """Build a Finishing from a user's options and the photograph. Raises InputError if an option cannot be understood or met.

    plate_rgb: the photograph, or the first frame of a video; next_rgb: its second frame, if it is a video. photo: the file of the
    plate, for options that read its metadata.
    """
    vignetting = _vignetting(options.vignetting, photo)
    colour = _colour(options, plate_rgb, photo, vignetting)
    grain = _grain(options, plate_rgb, next_rgb)
    return Finishing(None if colour.is_nothing else colour, vignetting, grain, _light_wrap(options.light_wrap))


def white_balanced(options: LookOptions) -> Finishing:
    """Build a Finishing of the white balance alone, which costs nothing, as for drafts. Raises InputError for what is no temperature."""
    kelvin = options.match_white_k
    return Finishing() if kelvin is None else Finishing(ColourMatch(triple_of(np.asarray(white_balance_gain(kelvin)))))


def matched_finishing(options: LookOptions, plate_rgb: Picture, photo: Path, *, uncompressed: bool = False) -> tuple[Finishing, list[str]]:
    """Build a Finishing with black, grain and compression as the photograph has them, where the options say nothing of these.

    Also returns the options of what was matched. uncompressed: leave the compression out, as for linear light.
    What a scene shows can be lighter than black, and textured where it seems to be noise: no black is lifted that is not surely one, and
    grain is never stronger than that of high ISO. So an object in a picture of sand alone gets neither.
    """
    finishing, matched = finishing_of(options, plate_rgb, photo), []
    if options.match_black is None and options.match_grey is None and min(plate_rgb.shape[:2]) >= _LEAST_PX:
        black = darkest_black(plate_rgb)
        if 0.0 < max(black) <= _SURELY_BLACK:
            finishing = replace(finishing, colour=replace(finishing.colour or ColourMatch(), black=black))
            matched.append("--match-black")
    if options.grain is None:
        with suppress(InputError):
            finishing = replace(finishing, grain=_at_most(measured_grain(plate_rgb, options.seed)))
        finishing = replace(finishing, compression=None if uncompressed else JpegCompression.of(photo))
    if options.grain is None and (finishing.compression or (finishing.grain is not None and not finishing.grain.is_nothing)):
        matched.append("--grain")
    return finishing, matched


def _at_most(grain: Grain) -> Grain:
    """Return the grain, weakened as a whole where it would be stronger on a screen than that of high ISO, at any level."""
    shown = np.square(_MOST_GRAIN * np.diff(srgb_to_linear(_SHOWN)) / np.diff(_SHOWN))  # what a step on the screen is in linear light
    seen = grain.level.variance(np.repeat(srgb_to_linear(_SHOWN[:-1])[:, None], 3, axis=1)).max(axis=1)
    factor = float(np.minimum(1.0, shown / np.maximum(seen, 1e-12)).min())
    shot, read = (triple_of(factor * np.array(each)) for each in (grain.level.shot, grain.level.read))
    return replace(grain, level=NoiseLevel(shot, read))


def _colour(options: LookOptions, plate_rgb: Picture, photo: Path | None, vignetting: Vignetting | None) -> ColourMatch:
    """A card says all that exposure and white balance say, so it excludes them."""
    black = _black(options.match_black, plate_rgb)
    if options.match_grey is not None:
        if options.match_exposure is not None or options.match_white_k is not None:
            raise InputError("--match-grey sets exposure and white balance: leave out --match-exposure and --match-white")
        box = PixelBox.parse(options.match_grey)
        falloff = (1.0, 1.0, 1.0) if vignetting is None else falloff_at(vignetting, box.x_px, box.y_px, plate_rgb.shape[:2])
        return grey_card_match(plate_rgb, box, rendered=options.grey_value, black=black, falloff=falloff)
    gain = np.ones(3)
    if options.match_exposure is not None:
        gain = gain * matched_exposure(_plate_exposure(options, photo), stated_exposure(options.match_exposure)).gain
    elif options.plate_exposure is not None:
        raise InputError("--plate-exposure is for --match-exposure PHOTO, which it is compared with: give both")
    if options.match_white_k is not None:
        gain = gain * white_balance_gain(options.match_white_k)
    return ColourMatch(triple_of(gain), black)


def _plate_exposure(options: LookOptions, photo: Path | None) -> Exposure:
    if options.plate_exposure is not None:
        return Exposure.parse(options.plate_exposure)
    if photo is None:
        raise InputError(
            "--match-exposure needs a photograph that states how it was taken (Exif; an EXR header), but this plate is in no such file: "
            "give --plate-exposure SECONDS,ISO,F-NUMBER"
        )
    return stated_exposure(photo)


def _black(text: str | None, plate_rgb: Picture) -> Triple:
    if text is None or text == OFF:
        return NO_BLACK
    return darkest_black(plate_rgb) if text == AUTO else patch_colour(plate_rgb, PixelBox.parse(text, "--match-black"))


def _vignetting(text: str | None, photo: Path | None) -> Vignetting | None:
    if text is None or text == OFF:
        return None
    if text == AUTO:
        return falloff_of_photo(_required(photo, "--vignetting auto"))
    return read_flat_field(text) if Path(text).is_file() else RadialFalloff.parse(text)


def _grain(options: LookOptions, plate_rgb: Picture, next_rgb: Picture | None) -> Grain | None:
    if options.grain is None or options.grain == OFF:
        return None
    if options.grain != AUTO:
        return replace(read_grain(options.grain), seed=options.seed)
    return measured_grain(plate_rgb, options.seed) if next_rgb is None else _grain_of_video(plate_rgb, next_rgb, options.seed)


def _grain_of_video(first: Picture, second: Picture, seed: int) -> Grain:
    """Measure grain in a pair of frames; in the first alone if everything moves or the encoder has copied it."""
    try:
        return measured_grain_of_pair(first, second, seed)
    except InputError:
        return measured_grain(first, seed)


def _light_wrap(text: str | None) -> LightWrap | None:
    if text is None or text == OFF:
        return None
    return LightWrap(*numbers_in(text, "--light-wrap: expected STRENGTH or STRENGTH,SIGMA in pixels, such as 0.3,8", (1, 2)))


def _required(photo: Path | None, option: str) -> Path:
    if photo is None:
        raise InputError(f"{option} needs a photograph that states how it was taken (Exif; an EXR header): this plate is in no such file")
    return photo
