"""Colour spaces of other programs by name, through OpenColorIO 2 (extra `ocio`).

    to_ours = ColorConversion.of("aces", "ARRI LogC4", REC709_LINEAR)
    plate_rgb = to_ours.applied(decoded_rgb)

"aces" is the studio configuration of the Academy that is built into OpenColorIO: ACES spaces, camera log curves, displays.
"""

import difflib
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exr_io import known_primaries
from mrbokeh.system.errors import InputError, MissingExtraError

REC709_LINEAR = "Linear Rec.709 (sRGB)"
"""Colour space of all pictures here, as the Academy's configurations name it; many others know it by the alias lin_rec709_srgb."""
BUILT_IN = {"aces": "studio-config-latest", "aces-cg": "cg-config-latest"}
_OURS = (REC709_LINEAR, "lin_rec709_srgb", "lin_rec709", "lin_srgb", "Utility - Linear - sRGB", "Linear Rec.709")
_NAMED = 5


@dataclass(frozen=True)
class ColorConversion:
    """Conversion from one colour space of a configuration to another."""

    source: str
    target: str
    processor: Any

    @classmethod
    def of(cls, config: Path | str | None, source: str, target: str) -> "ColorConversion":
        """Open a conversion from one colour space to another.

        config: "aces" (studio) or "aces-cg", both built in; a file (.ocio, .ocioz); None is the file that $OCIO names.
        source, target: colour spaces, aliases or roles ("scene_linear"). Raises InputError with the nearest names if one is unknown.
        """
        opened = open_config(config)
        _require_known(opened, source)
        _require_known(opened, target)
        return cls(source, target, opened.getProcessor(source, target).getDefaultCPUProcessor())

    @classmethod
    def to_rec709(cls, config: Path | str | None, source: str) -> "ColorConversion":
        """Open the conversion from a space of the configuration to linear Rec.709."""
        return cls.of(config, source, rec709_name(open_config(config)))

    @classmethod
    def from_rec709(cls, config: Path | str | None, target: str) -> "ColorConversion":
        """Open the conversion from linear Rec.709 to a space of the configuration."""
        return cls.of(config, rec709_name(open_config(config)), target)

    def applied(self, rgb: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
        """Return a converted copy. A premultiplied picture must be divided by alpha before a curve, but not before a matrix."""
        copy = np.array(rgb, np.float32, order="C")
        self.apply(copy)
        return copy

    def apply(self, rgb: Float32[np.ndarray, "height width 3"]) -> None:
        """Convert in place. Raises InputError if rows or pixels are not contiguous."""
        if not rgb.flags.c_contiguous:
            raise InputError("a picture to be converted in place must lie packed in memory: use `applied`, or make it contiguous")
        if rgb.size:
            self.processor.applyRGB(rgb)


@dataclass(frozen=True)
class NamedSpace:
    """Colour space by its name and its configuration; it can be pickled and is opened where it is used.

    config: as of ColorConversion.of, files as absolute paths. Premultiplied pictures may only go through spaces that are linear.
    """

    name: str
    config: str = "aces"

    @classmethod
    def of(cls, name: str, config: Path | str) -> "NamedSpace":
        """Return the space after a check. Raises InputError if the configuration or the space does not exist."""
        is_file = str(config) not in BUILT_IN and not str(config).startswith("ocio://")
        space = cls(name, str(Path(config).resolve()) if is_file else str(config))
        _require_known(open_config(space.config), name)
        return space

    @property
    def files(self) -> tuple[Path, ...]:
        """Return the configuration's file, if it is one."""
        return (Path(self.config),) if Path(self.config).is_absolute() else ()

    @property
    def is_linear(self) -> bool:
        """Return whether twice the light is twice the number, as in ACEScg and unlike in camera curves and on displays."""
        once = np.array([[[0.05, 0.2, 0.3]]], np.float32)
        return bool(np.allclose(self.from_rec709(2 * once), 2 * self.from_rec709(once), rtol=1e-4))

    @property
    def primaries(self) -> tuple[float, ...] | None:
        """Return CIE x, y of red, green, blue and white for an EXR header.

        None of a space that is not linear, or whose primaries are none of those in `mrbokeh.images.exr_io`.
        """
        if not self.is_linear:
            return None
        return known_primaries(self.to_rec709(np.eye(3, dtype=np.float32)[None])[0].T.astype(np.float64))

    def to_rec709(self, rgb: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
        """Convert numbers of this space to linear Rec.709."""
        return _conversion(self.config, self.name, True).applied(rgb)

    def from_rec709(self, rgb: Float32[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
        """Convert linear Rec.709 to numbers of this space."""
        return _conversion(self.config, self.name, False).applied(rgb)


@lru_cache(maxsize=8)
def _conversion(config: str, name: str, inwards: bool) -> ColorConversion:
    return ColorConversion.to_rec709(config, name) if inwards else ColorConversion.from_rec709(config, name)


def open_config(config: Path | str | None) -> Any:
    """Open an OpenColorIO configuration, cached because the built-in ones take a moment."""
    if config is None:
        config = os.environ.get("OCIO", "")
        if not config:
            raise InputError(
                "expected an OpenColorIO configuration, but $OCIO is not set: set it, name a file, or take the built-in 'aces'"
            )
    return _opened(BUILT_IN.get(str(config), str(config)))


def rec709_name(opened: Any) -> str:
    """Return the configuration's name of linear Rec.709. Raises InputError if it has none."""
    for name in _OURS:
        if opened.getColorSpace(name) is not None:
            return name
    raise InputError(f"the colour configuration has no linear Rec.709 (looked for {', '.join(_OURS)}): state its name for it")


@lru_cache(maxsize=4)
def _opened(config: str) -> Any:
    try:
        import PyOpenColorIO as ocio  # noqa: N813
    except ModuleNotFoundError as missing:
        raise MissingExtraError("opencolorio", "ocio") from missing
    try:
        if config in BUILT_IN.values() or config.startswith("ocio://"):
            return ocio.Config.CreateFromBuiltinConfig(config.removeprefix("ocio://"))
        return ocio.Config.CreateFromFile(config)
    except (ocio.Exception, ocio.ExceptionMissingFile) as error:
        told = str(error).splitlines()[0]
        raise InputError(f"expected an OpenColorIO configuration, {' or '.join(BUILT_IN)} or a file, at {config}: {told}") from None


def _require_known(opened: Any, name: str) -> None:
    """Raise InputError with similar names unless the configuration has this colour space, role or alias."""
    if opened.getColorSpace(name) is not None:
        return
    names = list(opened.getColorSpaceNames())
    aliases = [(alias, each.getName()) for each in opened.getColorSpaces() for alias in each.getAliases()]
    folded = {each.lower(): told for each, told in [*aliases, *((each, each) for each in names)]}
    near = [folded[each] for each in difflib.get_close_matches(name.lower(), folded, n=_NAMED, cutoff=0.4)]
    near += [each for each in names if name and name.lower() in each.lower()][:_NAMED]
    told = f"did you mean {', '.join(dict.fromkeys(near))}?" if near else f"there are {', '.join(names)}"
    raise InputError(f"the colour configuration has no colour space {name!r}: {told}")
