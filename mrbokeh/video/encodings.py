"""Encodings that videos are written in, by name; every one can be cut between any two segments and joined again without encoding."""

from pathlib import Path
from typing import NamedTuple

from mrbokeh.system.errors import InputError


class Encoding(NamedTuple):
    """Encoding of a video.

    options: of the FFmpeg encoder. tag: the four letters that players of MP4 and QuickTime expect, if FFmpeg's own are others. alpha:
    whether pictures with coverage are stored. least_px: the smallest width and height that the encoder takes.
    """

    codec: str
    pixel_format: str
    bits: int
    suffixes: tuple[str, ...]
    options: dict[str, str]
    tag: str = ""
    alpha: bool = False
    least_px: tuple[int, int] = (2, 2)

    @property
    def stands_alone(self) -> bool:
        """Whether every picture can be shown without any other, so that pictures may be left out or come twice."""
        return ".nut" not in self.suffixes

    def part_suffix(self, suffix: str) -> str:
        """Return the suffix of a part of the video: NUT keeps packets of H.264 and H.265 as they left the encoder."""
        return ".nut" if ".nut" in self.suffixes else suffix


_H26X = (".mp4", ".mov", ".mkv", ".nut")
_PRORES = {"vendor": "apl0"}
# A keyframe each, or a part would begin with statistics other than those of the whole.
_FFV1 = {"level": "3", "slices": "16", "slicecrc": "1", "g": "1"}
# Without this the pictures differ from run to run by a few bits, and from processor to processor.
_X264 = {"preset": "medium", "x264-params": "cpu-independent=1:rc-lookahead=20"}
# One thread, or the pictures would depend on the number of cores; groups of pictures do not refer to others, so that parts can be joined.
_X265 = "open-gop=0:frame-threads=1:pools=none:log-level=none"

ENCODINGS = {
    "h264": Encoding(codec="libx264", pixel_format="yuv420p", bits=8, suffixes=_H26X, options={"crf": "14", **_X264}),
    "h264-10bit": Encoding(codec="libx264", pixel_format="yuv420p10le", bits=10, suffixes=_H26X, options={"crf": "12", **_X264}),
    "h265-10bit": Encoding(
        codec="libx265",
        pixel_format="yuv420p10le",
        bits=10,
        suffixes=_H26X,
        options={"crf": "12", "preset": "medium", "x265-params": _X265},
        tag="hvc1",
        least_px=(32, 32),
    ),
    "prores4444": Encoding(
        codec="prores_ks", pixel_format="yuv444p10le", bits=10, suffixes=(".mov",), options={"profile": "4444", **_PRORES}
    ),
    "prores4444-alpha": Encoding(
        codec="prores_ks",
        pixel_format="yuva444p10le",
        bits=10,
        suffixes=(".mov",),
        options={"profile": "4444", "alpha_bits": "16", **_PRORES},
        alpha=True,
    ),
    "prores422": Encoding(codec="prores_ks", pixel_format="yuv422p10le", bits=10, suffixes=(".mov",), options={"profile": "hq", **_PRORES}),
    "dnxhr-hqx": Encoding(
        codec="dnxhd", pixel_format="yuv422p10le", bits=10, suffixes=(".mov", ".mxf"), options={"profile": "dnxhr_hqx"}, least_px=(256, 120)
    ),
    "ffv1": Encoding(codec="ffv1", pixel_format="gbrp16le", bits=16, suffixes=(".mkv",), options=_FFV1),
    "ffv1-alpha": Encoding(codec="ffv1", pixel_format="gbrap16le", bits=16, suffixes=(".mkv",), options=_FFV1, alpha=True),
}
_BY_SUFFIX = {".mp4": "h264", ".mov": "prores4444", ".mkv": "ffv1", ".mxf": "dnxhr-hqx"}
_BY_SUFFIX_WITH_ALPHA = {".mov": "prores4444-alpha", ".mkv": "ffv1-alpha"}


def encoding_for(path: Path, name: str | None = None) -> Encoding:
    """The encoding of that name, or the usual one of the suffix."""
    return ENCODINGS[encoding_name(path, name)]


def with_alpha(path: Path) -> str | None:
    """The usual encoding of the suffix that keeps coverage, or None where there is none."""
    return _BY_SUFFIX_WITH_ALPHA.get(Path(path).suffix.lower())


def encoding_name(path: Path, name: str | None = None) -> str:
    """Return the encoding's name. Raises InputError if it does not fit the suffix.

    Usual are .mp4 h264, .mov prores4444, .mxf dnxhr-hqx, .mkv ffv1 (lossless, 16 bit).
    """
    suffix = Path(path).suffix.lower()
    name = name or _BY_SUFFIX.get(suffix)
    if name is None:
        expected = f"{', '.join(_BY_SUFFIX)} or frames.%04d.exr"
        raise InputError(f"cannot write {path}: expected {expected}, not {suffix or 'a file without suffix'}")
    if name not in ENCODINGS:
        raise InputError(f"expected an encoding ({', '.join(ENCODINGS)}), got {name!r}")
    if suffix not in ENCODINGS[name].suffixes:
        raise InputError(
            f"{path}: {name} is written to {' or '.join(ENCODINGS[name].suffixes)}, not to {suffix or 'a file without suffix'}"
        )
    return name
