"""MurmurHash3_x86_32 with seed 0 (Appleby, public domain), and the float that Cryptomatte 1.2 stores in its place."""

import struct

_MASK = 0xFFFFFFFF


def murmur3_32(data: bytes) -> int:
    """The hash of bytes, in 0 to 2^32 - 1."""
    hashed, whole = 0, len(data) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        hashed = (_rotated(hashed ^ _mixed(word), 13) * 5 + 0xE6546B64) & _MASK
    hashed ^= _mixed(int.from_bytes(data[whole:], "little")) ^ len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        hashed = ((hashed ^ hashed >> shift) * factor) & _MASK
    return hashed ^ hashed >> 16


def id_bits(name: str) -> int:
    """The bits of a name's ID. An exponent of zeros or ones would be denormal, infinite or NaN: its lowest bit is turned over."""
    hashed = murmur3_32(name.encode("utf-8"))
    return hashed ^ 1 << 23 if hashed >> 23 & 255 in (0, 255) else hashed


def _mixed(word: int) -> int:
    return _rotated((word * 0xCC9E2D51) & _MASK, 15) * 0x1B873593 & _MASK


def _rotated(word: int, bits: int) -> int:
    return (word << bits | word >> 32 - bits) & _MASK
