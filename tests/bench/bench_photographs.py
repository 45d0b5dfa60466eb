"""How near `mrbokeh composite` comes to an object that was in the photograph: `python -m tests.bench.bench_photographs OUT [COUNT]`.

Rooms, tables and streets (half of them in the sun) are traced by Mitsuba with and without an object, through three lenses, with noise and
as JPEG 85; the file states focal length, f-number and 35-mm equivalent. The object is put in by its place, its height in pixels and its
focus, with nothing guessed (--plain, at its true place) and with all defaults; in the sun also by a shadow (--sun-by). Told are PSNR over
all pixels that the object changes in the truth or in a result, and the light on the object over that of the truth. OUT keeps all pictures.
It needs Mitsuba 3 (`pip install 'mrbokeh[mitsuba]'`) and LLVM's library.
"""

import json
import math
import struct
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from mrbokeh.images.color import linear_to_srgb, luminance, srgb_to_linear
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.mitsuba.mitsuba_tracer import load
from mrbokeh.scene.staging.scene_description import looking_down
from mrbokeh.scene.staging.staged_scene import Assets
from mrbokeh.scene.virtual_scene import world_from_scene_placing
from tests.bench.machine import tell

WIDTH_PX, HEIGHT_PX, SAMPLES = 600, 400, 96
KINDS, LENSES_MM = ("room", "table", "street", "sunny street"), (24.0, 35.0, 50.0)
ALIEN, OBJECT = Path("mrbokeh/demo_data/objects/alien.glb"), "object.glb"
_SHOT, _READ, _GREY = 2e-4, 2e-6, 0.2
Vector = np.ndarray


@dataclass
class Place:
    """A scene around a camera at the origin: x right, y down, z forward, upright. The object is height_m high and stands at foot_m."""

    kind: str
    rng: np.random.Generator
    shapes: dict[str, Any] = field(default_factory=dict)
    sun: Vector | None = None

    def __post_init__(self) -> None:
        rng = self.rng
        table = self.kind == "table"
        self.eyes_m = float(rng.uniform(0.4, 0.6) if table else rng.uniform(1.2, 1.7))
        self.height_m = float(rng.uniform(0.1, 0.16) if table else rng.uniform(0.35, 0.7))
        away_m = float(rng.uniform(0.7, 1.0) if table else rng.uniform(2.2, 3.6))
        self.foot_m = np.array([rng.uniform(-0.12, 0.12) * away_m, self.eyes_m, away_m])
        down_rad = math.atan2(self.eyes_m - 0.5 * self.height_m, away_m) - math.radians(rng.uniform(-3.0, 5.0))
        self.world_from_camera = looking_down(down_rad, math.radians(rng.normal(0.0, 1.0)))
        self.focal_mm = float(rng.choice(LENSES_MM))
        self.f_number = float(rng.choice([2.8, 5.6]))
        (self._street if "street" in self.kind else self._room)()

    @property
    def focal_px(self) -> float:
        return self.focal_mm / 36.0 * WIDTH_PX

    def pixel(self, point_m: Vector) -> tuple[float, float]:
        seen = self.world_from_camera.T @ point_m
        x, y = self.focal_px * seen[:2] / seen[2] + (WIDTH_PX / 2, HEIGHT_PX / 2)
        return float(x), float(y)

    def add(self, shape: dict[str, Any]) -> None:
        self.shapes[f"shape{len(self.shapes)}"] = shape

    def painted(self, low: float, high: float, cells: int = 24) -> dict[str, Any]:
        """Return a matte surface of a colour with spots of two sizes."""
        import mitsuba as mi

        base = self.rng.uniform(low, high) * self.rng.uniform(0.75, 1.15, 3)
        fine, coarse = (self.rng.uniform(0.6, 1.2, (n, n, 1)) for n in (256, cells))
        spots = fine * cv2.resize(coarse, (256, 256), interpolation=cv2.INTER_CUBIC)[..., None]
        data = np.clip(base * spots, 0.01, 0.9).astype(np.float32)
        return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True}}

    def quad(self, corner: Vector, along: Vector, up: Vector, **more: Any) -> None:
        """Add a rectangle by its middle and its half sides, seen from both sides."""
        import mitsuba as mi

        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = along, up, np.cross(along, up), corner
        self.add({"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), **more})

    def box(self, base_m: Vector, half_m: Vector, turn_deg: float) -> None:
        import mitsuba as mi

        move = mi.ScalarTransform4f().translate((base_m - [0.0, half_m[1], 0.0]).tolist())
        turned = move @ mi.ScalarTransform4f().rotate([0, 1, 0], turn_deg) @ mi.ScalarTransform4f().scale(half_m.tolist())
        self.add({"type": "cube", "to_world": turned, "bsdf": self.painted(0.05, 1.0)})

    def boxes(self, count: int, nearest_m: float, farthest_m: float, size_m: float) -> None:
        for _ in range(count):
            z_m, side = self.rng.uniform(nearest_m, farthest_m), self.rng.choice([-1.0, 1.0])
            base_m = np.array([self.foot_m[0] + side * self.rng.uniform(0.35, 0.6) * z_m, self.eyes_m, z_m])
            self.box(base_m, size_m * self.rng.uniform(0.3, 1.0, 3), self.rng.uniform(0.0, 90.0))

    def _room(self) -> None:
        rng, floor_m = self.rng, self.eyes_m
        if self.kind == "table":
            self.quad(np.array([0.0, self.eyes_m, 0.9]), np.array([0.9, 0, 0]), np.array([0, 0, 0.55]), bsdf=self.painted(0.2, 0.6))
            self.boxes(3, 0.9, 1.3, 0.08)
            floor_m += 0.75
        width_m, behind_m, front_m, above_m = 2.4, -1.5, 5.5, floor_m - 2.6
        middle_m = np.array([0.0, (floor_m + above_m) / 2, (behind_m + front_m) / 2])
        half = np.array([width_m, 1.3, (front_m - behind_m) / 2])
        for axis in range(3):
            for sign in (-1.0, 1.0):
                sides = np.diag(half)
                centre = middle_m + sign * sides[axis]
                paint = self.painted(0.2, 0.5) if axis == 1 and sign > 0 else self.painted(0.5, 0.8, 4)
                self.quad(centre, sides[(axis + 1) % 3], sides[(axis + 2) % 3], bsdf={"type": "twosided", "bsdf": paint})
        if self.kind == "room":
            self.boxes(5, 2.0, 5.0, 0.5)
        lamp_m = np.array([rng.uniform(-1.2, 1.2), above_m + 0.02, rng.uniform(0.0, 4.0)])
        size_m, strength = rng.uniform(0.15, 0.5), rng.uniform(4.0, 12.0)
        lamp = {"type": "area", "radiance": {"type": "rgb", "value": (strength / size_m * np.array([1.0, 0.85, 0.65])).tolist()}}
        self.quad(lamp_m, np.array([size_m, 0, 0]), np.array([0, 0, size_m]), emitter=lamp)
        side = rng.choice([-1.0, 1.0])
        window_m = np.array([side * (width_m - 0.01), floor_m - 1.5, rng.uniform(0.0, 3.5)])
        day = {"type": "area", "radiance": {"type": "rgb", "value": (rng.uniform(2.0, 12.0) * np.array([0.85, 0.95, 1.1])).tolist()}}
        self.quad(window_m, np.array([0, 0, side * 0.7]), np.array([0, 0.6, 0]), emitter=day)

    def _street(self) -> None:
        import mitsuba as mi

        rng = self.rng
        ground = self.painted(0.15, 0.4, 120)
        ground["reflectance"]["to_uv"] = mi.ScalarTransform4f().scale([12, 12, 1])
        self.quad(
            np.array([0.0, self.eyes_m, 20.0]), np.array([40.0, 0, 0]), np.array([0, 0, 40.0]), bsdf={"type": "twosided", "bsdf": ground}
        )
        for side in (-1.0, 1.0):
            for z_m in (6.0, 14.0, 24.0):
                self.box(np.array([side * rng.uniform(6.5, 8.0), self.eyes_m, z_m]), np.array([2.5, rng.uniform(2.0, 5.0), 3.5]), 0.0)
        self.boxes(3, 4.0, 9.0, 0.8)
        sky = np.array([0.8, 0.95, 1.2]) if self.kind == "sunny street" else np.array([0.97, 1.0, 1.03])
        self.shapes["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": (0.3 * sky).tolist()}}
        self.post_m = self.foot_m + np.array([0.9 * rng.choice([-1.0, 1.0]), 0.0, 0.7])
        if self.kind == "sunny street":
            above, right = math.radians(rng.uniform(25.0, 55.0)), math.radians(rng.uniform(-180.0, 180.0))
            self.sun = np.array([math.sin(right) * math.cos(above), -math.sin(above), math.cos(right) * math.cos(above)])
            # The sky gives 0.3 pi on level ground, which is a sixth of all light there.
            strength = 5.0 * 0.3 * math.pi / math.sin(above) * np.array([1.05, 1.0, 0.9])
            self.shapes["sun"] = {
                "type": "directional",
                "direction": (-self.sun).tolist(),
                "irradiance": {"type": "rgb", "value": strength.tolist()},
            }
            self.box(self.post_m, np.array([0.03, 0.25, 0.03]), 20.0)

    def traced(self, objects: dict[str, Any]) -> np.ndarray:
        """Return linear light (H, W, 3) of the scene with objects, through the lens focused on the foot."""
        import mitsuba as mi

        forward, down = self.world_from_camera[:, 2], self.world_from_camera[:, 1]
        look = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=forward.tolist(), up=(-down).tolist())
        lens = {
            "type": "thinlens",
            "fov_axis": "x",
            "fov": math.degrees(2.0 * math.atan(18.0 / self.focal_mm)),
            "aperture_radius": 0.5e-3 * self.focal_mm / self.f_number,
            "focus_distance": self.focus_m,
            "to_world": look,
            "film": {"type": "hdrfilm", "width": WIDTH_PX, "height": HEIGHT_PX, "rfilter": {"type": "box"}},
        }
        scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 6}, "sensor": lens, **self.shapes, **objects}
        return np.asarray(mi.render(mi.load_dict(scene), spp=SAMPLES))[..., :3]

    @property
    def focus_m(self) -> float:
        return float(self.world_from_camera[:, 2] @ (self.foot_m - [0.0, 0.5 * self.height_m, 0.0]))


def without_metal(glb: Path, out: Path) -> Path:
    """Write a GLB whose surfaces are no metals: of those programs disagree, as only some give back what rough metal reflects twice."""
    data = glb.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    for material in document["materials"]:
        material.setdefault("pbrMetallicRoughness", {})["metallicFactor"] = 0.0
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    out.write_bytes(data[:8] + struct.pack("<III", 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest)
    return out


def as_mitsuba(mesh: Mesh, name: str) -> Any:
    """Return a mesh of one colour, with a reflection near that of glTF for what is no metal."""
    import mitsuba as mi

    colour = {"type": "rgb", "value": list(mesh.material.base_color[:3])}
    paint = {"type": "principled", "base_color": colour, "roughness": mesh.material.roughness, "specular": 0.5}
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": paint})
    made = mi.Mesh(name, len(mesh.positions_m), len(mesh.triangles), has_vertex_normals=True, props=props)
    told = mi.traverse(made)
    told["vertex_positions"] = mesh.positions_m.astype(np.float32).ravel()
    told["vertex_normals"] = mesh.normals.astype(np.float32).ravel()
    told["faces"] = mesh.triangles.astype(np.uint32).ravel()
    told.update()
    return made


def photographed(light: np.ndarray, exposure: float, noise: np.ndarray) -> np.ndarray:
    """Return 8-bit codes of a sensor with that noise (H, W, 3) of deviation 1."""
    exposed = exposure * light
    return np.round(255.0 * linear_to_srgb(np.clip(exposed + noise * np.sqrt(_SHOT * exposed + _READ), 0.0, 1.0))).astype(np.uint8)


def write_jpeg(path: Path, codes: np.ndarray, place: Place) -> None:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "mrbokeh", "traced"
    of_lens = exif.get_ifd(0x8769)
    of_lens[0x920A], of_lens[0x829D], of_lens[0xA405] = place.focal_mm, place.f_number, round(place.focal_mm)
    Image.fromarray(codes).save(path, quality=85, exif=exif)


def composited(photo: Path, out: Path, *options: str) -> np.ndarray:
    words = [
        sys.executable,
        "-m",
        "mrbokeh.cli",
        "composite",
        str(photo),
        "--object",
        str(out.parent / OBJECT),
        *options,
        "--out",
        str(out),
        "--overwrite",
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{photo}: {done.stderr.strip().splitlines()[-1]}")
    return np.asarray(Image.open(out))


def measure(kind: str, number: int, out: Path) -> dict[str, Any]:
    """Trace one place, put the object in, and return PSNR in dB and the object's light over the truth's, by way of doing it."""
    rng = np.random.default_rng([number, *kind.encode()])
    place, name, turn_deg = Place(kind, rng), f"{kind.replace(' ', '_')}_{number}", float(rng.uniform(150.0, 210.0))
    asset = Assets().glb(out / OBJECT).scene_at(0.0)
    placed = asset.transformed(world_from_scene_placing(asset, tuple(place.foot_m), place.height_m, math.radians(turn_deg)))
    objects = {f"object{index}": as_mitsuba(mesh, f"object{index}") for index, mesh in enumerate(placed.drawn_meshes)}
    without, with_object = place.traced({}), place.traced(objects)
    # As cameras meter: the mean is middle grey.
    exposure = _GREY / float(luminance(without).mean())
    noise = rng.standard_normal((HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32)
    plate, truth = (photographed(each, exposure, noise) for each in (without, with_object))
    photo = out / f"{name}.jpg"
    write_jpeg(photo, plate, place)
    write_jpeg(out / f"{name}_truth.jpg", truth, place)
    plate = np.asarray(Image.open(photo))
    foot_m = place.world_from_camera.T @ place.foot_m
    x_px, y_px = place.pixel(place.foot_m)
    high = f"{place.focal_px * place.height_m / foot_m[2]:.1f}px"
    same = ("--focus", f"{place.focus_m:.3f}", "--turn", f"{turn_deg - 180.0:.1f}", "--height", high)
    ways = {"plain": ("--plain", "--at", ",".join(f"{each:.4f}" for each in foot_m)), "default": ("--at-pixel", f"{x_px:.1f},{y_px:.1f}")}
    if place.sun is not None:
        top_m = place.post_m - [0.0, 0.5, 0.0]
        pixels = [place.pixel(each) for each in (top_m, place.post_m, top_m - place.sun * 0.5 / -place.sun[1])]
        if all(0.0 <= x < WIDTH_PX and 0.0 <= y < HEIGHT_PX for x, y in pixels):
            ways["sun-by"] = (*ways["default"], "--sun-by", ":".join(f"{x:.1f},{y:.1f}" for x, y in pixels))
    made = {way: composited(photo, out / f"{name}_{way}.png", *same, *options) for way, options in ways.items()}
    changed = [np.abs(each.astype(int) - plate).max(axis=2) > 12 for each in (truth, *made.values())]
    region = cv2.dilate(np.logical_or.reduce(changed).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    covered = np.asarray(made["plain"] != plate).any(axis=2)
    covered = cv2.erode((covered & changed[0]).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    of_truth = luminance(srgb_to_linear(truth[covered] / 255.0)).mean()
    result: dict[str, Any] = {"name": name, "focal_mm": place.focal_mm}
    for way, codes in made.items():
        error = np.square(codes[region].astype(float) - truth[region]).mean()
        light = luminance(srgb_to_linear(codes[covered] / 255.0)).mean() / of_truth
        result |= {f"{way}_db": 10.0 * math.log10(255.0**2 / error), f"{way}_light": float(light)}
    return result


def main(out: Path, count: int = 40) -> None:
    load()
    out.mkdir(parents=True, exist_ok=True)
    without_metal(ALIEN, out / OBJECT)
    results = []
    for index in range(count):
        results.append(measure(KINDS[index % len(KINDS)], index // len(KINDS), out))
        print(", ".join(f"{key} {value:.2f}" if isinstance(value, float) else str(value) for key, value in results[-1].items()), flush=True)
    for way in ("default", "sun-by"):
        told = [each for each in results if f"{way}_db" in each]
        if not told:
            continue
        gain_db = np.array([each[f"{way}_db"] - each["plain_db"] for each in told])
        off = np.abs(np.log([each[f"{way}_light"] for each in told]))
        print(f"{way}: {np.median(gain_db):+.1f} dB over --plain, 6 dB or more in {(gain_db >= 6.0).sum()} of {len(told)}")
        print(f"  light on the object within 10 % in {(off < math.log(1.1)).sum()}, within 30 % in {(off < math.log(1.3)).sum()}")
    tell()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 40)
