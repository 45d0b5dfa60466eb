"""PNG files without what libpng would talk about: it writes its complaints to standard error itself, beside our one sentence."""

import zlib

import numpy as np
from jaxtyping import UInt8

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_BEFORE_DATA, _CRC = 8, 4
_LAST = b"IEND"
_OF_PIXELS = {b"IHDR", b"PLTE", b"tRNS", b"IDAT", _LAST}


def without_chatter(data: UInt8[np.ndarray, " bytes"]) -> UInt8[np.ndarray, " fewer"] | None:
    """The chunks that say what the pixels are (PNG specification, third edition, section 5), or None where one is missing or damaged.

    Profiles, comments and the like are left out: their numbers are not asked for here, and many are written wrongly. What is no PNG, or has
    none of them, is returned as it is.
    """
    if data[: len(SIGNATURE)].tobytes() != SIGNATURE:
        return data
    whole, at, kind = data.data, len(SIGNATURE), b""
    kept: list[bytes | memoryview] = [SIGNATURE]
    while kind != _LAST:
        after = at + _BEFORE_DATA + int.from_bytes(whole[at : at + 4], "big") + _CRC
        if after > len(whole) or at + _BEFORE_DATA > len(whole):
            return None
        kind = bytes(whole[at + 4 : at + _BEFORE_DATA])
        if kind in _OF_PIXELS:
            if zlib.crc32(whole[at + 4 : after - _CRC]) != int.from_bytes(whole[after - _CRC : after], "big"):
                return None
            kept.append(whole[at:after])
        at = after
    return data if sum(map(len, kept)) == len(data) else np.frombuffer(b"".join(kept), np.uint8)
