"""The scene file: TOML to SceneDescription.

    up = "-z"                     # what points up in the tracker's world: "-z" a board, "+z", "-y", "+y"

    [[object]]
    name = "lantern"
    glb = "lantern.glb"           # all paths are relative to this file
    position_m = [0.10, 0.05, 0]  # where the middle of its underside stands, in the tracker's world (of a board: its corner is 0)
    yaw_deg = 30                  # about the vertical, clockwise seen from above
    height_m = 0.2                # or scale = 1.0; without either it keeps the file's size
    animation = "Walk"            # a name in the GLB; without it nothing moves
    loop = true
    visible = true

    [light]                       # without any light: even grey and a sun; lights of GLB files are left out
    environment = "studio.hdr"    # panorama, EXR or HDR; without [[sun]] its own sun is taken out to cast the shadow
    rotation_deg = 0              # clockwise seen from above
    exposure = 1.0                # a factor on all light

    [[sun]]
    direction = [0.4, 0.5, 1.0]   # the way its rays travel, in the tracker's world
    irradiance = 3.0              # or [r, g, b]

    [shadow]                      # on the table; without it there is none
    size_m = 1.0                  # side of the square that catches it
    centre_m = [0, 0, 0]
    strength = 0.6                # 0 to 1

    [occlusion]                   # real things that hide virtual ones
    depth = "depth.exr"           # with camera = "camera.json", the camera that saw that depth
    mask = "mask.png"             # or: for a camera that stands still, white where something real is in front

    [lens]
    file = "lens.json"

    [renderer]
    name = "polygon"

A key that nothing knows is an error.

Values of a table of the scene file, checked one by one: texts, switches and files beside what mrbokeh's Values knows.
"""

import tomllib
from collections.abc import Collection
from math import radians
from pathlib import Path
from typing import Any

from mrbokeh.optics.lens_file import Values
from mrbokeh.renderers.choose import DEFAULT
from mrbokeh.scene.staging.scene_description import Lighting, PlacedObject, RealThings, SceneDescription, ShadowPlane, Sun, Triple
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD

_TABLES = ("up", "object", "light", "sun", "shadow", "occlusion", "lens", "renderer")


class SceneValues(Values):
    """Table of a TOML file; messages name the file, the table and the key."""

    @classmethod
    def of(cls, document: Any, where: str, known: Collection[str]) -> "SceneValues":
        return cls(document, where, known, ())

    def above_zero(self, key: str, default: float) -> float:
        value = self.number(key, default)
        if not value > 0:
            raise self._wrong(key, "a number above 0")
        return value

    def share(self, key: str, default: float) -> float:
        value = self.number(key, default)
        if not 0.0 <= value <= 1.0:
            raise self._wrong(key, "a number from 0 to 1")
        return value

    def switch(self, key: str, default: bool) -> bool:
        value = self.document.get(key, default)
        if not isinstance(value, bool):
            raise self._wrong(key, "true or false")
        return value

    def chosen(self, key: str, choices: Collection[str], default: str) -> str:
        value = self.document.get(key, default)
        if value not in choices:
            raise self._wrong(key, "one of " + ", ".join(sorted(choices)))
        return str(value)

    def optional_text(self, key: str) -> str | None:
        return self.text(key) if key in self.document else None

    def per_colour(self, key: str, default: float) -> Triple:
        """One number of 0 or more for all colours, or [r, g, b]."""
        value = self.document.get(key, default)
        rgb = self.three(key) if isinstance(value, list) else (self.number(key, default),) * 3
        if min(rgb) < 0:
            raise self._wrong(key, "a number of 0 or more, or three of them")
        return rgb

    def file(self, key: str, folder: Path) -> Path:
        """A file that exists, beside the scene file where its path is relative."""
        path = folder / self.text(key)
        if not path.is_file():
            raise InputError(f"{self.where}: expected {key} to be a file, but there is none at {path}")
        return path

    def optional_file(self, key: str, folder: Path) -> Path | None:
        return self.file(key, folder) if key in self.document else None


def read_scene_file(path: Path) -> SceneDescription:
    """Read and check a scene file; InputError with one sentence for the first mistake found."""
    values = SceneValues.of(_document(path), str(path), _TABLES)
    up = values.chosen("up", UPRIGHT_FROM_WORLD, "-z")
    objects = tuple(_object(each, path) for each in _tables(values, "object"))
    names = [each.name for each in objects]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{path}: expected every [[object]] to have a name of its own, but {', '.join(map(repr, twice))} comes twice")
    suns = tuple(_sun(each, path) for each in _tables(values, "sun"))
    lens, renderer = _table(values, "lens", ("file",)), _table(values, "renderer", ("name",))
    return SceneDescription(
        path=path,
        up=up,
        objects=objects,
        light=_light(_table(values, "light", ("environment", "rotation_deg", "exposure")), path, suns),
        shadow=_shadow(values),
        occlusion=_occlusion(values, path),
        lens=lens.file("file", path.parent) if lens else None,
        renderer=_renderer_name(renderer, path) if renderer else DEFAULT,
    )


def _document(path: Path) -> object:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise InputError(f"expected a scene file (TOML) at {path}, but there is none that can be read: check the name") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"expected a scene file (TOML) at {path}, but it cannot be read as such: {error}") from None


def _table(values: SceneValues, key: str, known: tuple[str, ...]) -> SceneValues | None:
    if key not in values.document:
        return None
    return SceneValues.of(values.document[key], f"{values.where}, [{key}]", known)


def _tables(values: SceneValues, key: str) -> list[object]:
    tables = values.document.get(key, [])
    if not isinstance(tables, list):
        raise InputError(f"{values.where}: expected {key} to be written as [[{key}]], which may come more than once, got [{key}]")
    return tables


def _object(document: object, path: Path) -> PlacedObject:
    known = ("name", "glb", "position_m", "yaw_deg", "height_m", "scale", "animation", "loop", "visible")
    values = SceneValues.of(document, f"{path}, [[object]]", known)
    name = values.text("name")
    values = SceneValues.of(document, f"{path}, [[object]] {name!r}", known)
    if {"height_m", "scale"} <= set(values.document):
        raise InputError(f"{values.where}: expected height_m or scale, got both: leave one of them out")
    return PlacedObject(
        name=name,
        glb=values.file("glb", path.parent),
        position_m=values.three("position_m"),
        yaw_rad=radians(values.number("yaw_deg", 0.0)),
        height_m=values.above_zero("height_m", 1.0) if "height_m" in values.document else None,
        scale=values.above_zero("scale", 1.0),
        animation=values.optional_text("animation"),
        loop=values.switch("loop", True),
        visible=values.switch("visible", True),
    )


def _sun(document: object, path: Path) -> Sun:
    values = SceneValues.of(document, f"{path}, [[sun]]", ("direction", "irradiance"))
    direction = values.three("direction")
    if not any(direction):
        raise InputError(f"{values.where}: expected direction to be the way its light travels, [x, y, z], got no direction")
    return Sun(direction, values.per_colour("irradiance", 1.6))


def _light(values: SceneValues | None, path: Path, suns: tuple[Sun, ...]) -> Lighting:
    if values is None:
        return Lighting(suns=suns)
    return Lighting(
        values.optional_file("environment", path.parent),
        radians(values.number("rotation_deg", 0.0)),
        values.above_zero("exposure", 1.0),
        suns,
    )


def _shadow(values: SceneValues) -> ShadowPlane | None:
    table = _table(values, "shadow", ("size_m", "strength", "centre_m"))
    if table is None:
        return None
    return ShadowPlane(table.above_zero("size_m", 1.0), table.share("strength", 0.6), table.three("centre_m"))


def _occlusion(values: SceneValues, path: Path) -> RealThings | None:
    table = _table(values, "occlusion", ("depth", "camera", "mask"))
    if table is None:
        return None
    keys = set(table.document)
    if keys not in ({"depth", "camera"}, {"mask"}):
        raise InputError(f"{table.where}: expected depth and camera, or mask alone, got {' and '.join(sorted(keys)) or 'nothing'}")
    return RealThings(*(table.optional_file(key, path.parent) for key in ("depth", "camera", "mask")))


def _renderer_name(values: SceneValues, path: Path) -> str:
    """A name of `mrbokeh.renderers.choose`, or a network beside the scene file."""
    name = values.text("name")
    return str(values.file("name", path.parent)) if name.lower().endswith(".onnx") else name
