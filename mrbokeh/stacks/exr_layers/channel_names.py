"""The names that programs give to colour, depth and motion in EXR files. One table; a name that is not in it has to be stated.

| program | colour | depth along the axis | motion |
|---|---|---|---|
| EXR itself, Nuke, mrbokeh | R G B A without a layer | Z or depth.Z | forward.u right, forward.v up |
| Blender, multilayer | VIEWLAYER.Combined.* | VIEWLAYER.Depth.Z, 1e10 is background | VIEWLAYER.Vector.Z, W: minus forward |
| Houdini, Mantra and Karma | R G B A, or C.* | Pz (part Pz) | motion.u, motion.v if so named |
| Arnold, V-Ray, Redshift | R G B A, or beauty.*, RGBA.* in parts | Z, depth.Z | by name |

Blender 4 writes one part, 5 one for each layer if not told otherwise; its File Output node calls depth Depth.V. Its Vector holds X, Y
from here to the frame before and Z, W from the frame after to here, so that both count against time when something moves evenly
(Cycles, geom/primitive.h; checked on renders of Blender 4.2 and 5.0); y goes up. Some of these programs write a depth that is not
along the axis (Nuke 1/z, Arnold and Karma if asked the distance along the ray): nobody can tell from the numbers, so
`FlatRender.depth_is` says it.
"""

from typing import NamedTuple


class MotionNames(NamedTuple):
    """Channels that hold motion to the right and up, and the factor that makes forward motion of them."""

    right: str
    up: str
    factor: float


COLOUR_LAYERS = ("", "Combined", "C", "RGBA", "rgba", "beauty", "Beauty")
"""Layers that are taken as the picture where none is stated; the unnamed one goes before all others."""
DEPTH_NAMES = ("Z", "depth.Z", "Depth.Z", "Depth.V", "depth.z", "Pz", "Pz.Z", "Pz.z", "Pz.Pz", "z")
MOTION_NAMES = (
    MotionNames("forward.u", "forward.v", 1.0),
    MotionNames("motion.u", "motion.v", 1.0),
    MotionNames("Vector.Z", "Vector.W", -1.0),
)
BACKGROUND_FROM = 1e9
"""Depths from here on are background: Blender writes 1e10 (inf as half)."""


def joined(layer: str, channel: str) -> str:
    """The full name of a channel of a layer; the unnamed layer is ""."""
    return f"{layer}.{channel}" if layer else channel
