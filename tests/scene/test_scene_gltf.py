"""glTF loading: small files written here with known content, and the real objects of the shared test data."""

import base64
import functools
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrbokeh.images.color import srgb_to_linear
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Environment, Scene, world_from_scene_placing
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.gltf.gltf_loader import GltfAsset, load_glb
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

OBJECTS = ("DepthOfFieldExample", "FlightHelmet", "Fox", "GolfBall", "alien", "cakeBirthday")
CORNERS = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], np.float32)
SQUARE = np.array([[0, 2, 1], [0, 3, 2]], np.uint16)
CAMERA = Camera(40, 40, (20.0, 20.0), (20.0, 20.0))
DARK = Environment(np.zeros((8, 16, 3), np.float32))


class GlbWriter:
    """Collects arrays into one buffer and writes a .glb or .gltf by hand, so that no library stands on both sides."""

    def __init__(self) -> None:
        self.blob = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "scene": 0}

    def view(self, data: bytes) -> int:
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)})
        self.blob += data + b"\0" * (-len(data) % 4)
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, kind: str, **more: object) -> int:
        component = {"int8": 5120, "uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}[values.dtype.name]
        accessor = {"bufferView": self.view(values.tobytes()), "componentType": component, "count": len(values), "type": kind, **more}
        self.json["accessors"].append(accessor)
        return len(self.json["accessors"]) - 1

    def square(self, material: dict[str, Any] | None = None, **attributes: int) -> None:
        """A square of +-1 m at z = 0 facing +z, as the file's only node."""
        uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        attributes = {"POSITION": self.accessor(CORNERS, "VEC3"), "TEXCOORD_0": self.accessor(uvs, "VEC2"), **attributes}
        primitive = {"attributes": attributes, "indices": self.accessor(SQUARE.ravel(), "SCALAR"), "material": 0}
        self.json |= {"materials": [material or {}], "meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}]}
        self.json["scenes"] = [{"nodes": [0]}]

    def write(self, path: Path) -> Path:
        self.json["buffers"] = [{"byteLength": len(self.blob)}]
        if path.suffix == ".gltf":
            self.json["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
            path.write_text(json.dumps(self.json))
            return path
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        header = struct.pack("<III", 0x46546C67, 2, 28 + len(text) + len(self.blob))
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(self.blob), 0x004E4942) + self.blob
        path.write_bytes(header + chunks)
        return path


def in_front(scene: Scene) -> Scene:
    """Two metres before the camera, lit by nothing."""
    return scene.transformed(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0], [0, 0, 0, 1]])).with_environment(DARK)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_axes_and_emissive_strength(tmp_path: Path, suffix: str) -> None:
    # glTF's +y is up: ours is down; its +z faces the viewer: ours points away. Emission is factor times strength, unclipped.
    writer = GlbWriter()
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 10.0}}
    writer.square({"emissiveFactor": [1.0, 0.5, 0.0], "extensions": strength})
    writer.json["nodes"][0]["translation"] = [0.5, 0.25, -3.0]
    mesh = load_glb(writer.write(tmp_path / f"square{suffix}")).meshes[0]
    # Without normals each triangle has corners of its own, in the order of the indices.
    assert np.allclose(mesh.positions_m, (CORNERS * [1, -1, 1] + [0.5, -0.25, 3.0])[SQUARE.ravel()])
    assert np.allclose(mesh.normals, [0, 0, -1])
    assert mesh.material.emissive == (10.0, 5.0, 0.0)
    rgb = EmbreeRaycaster().render(Scene((mesh,), environment=DARK), CAMERA).rgb[20, 23]
    assert np.allclose(rgb, [10.0, 5.0, 0.0], rtol=1e-6)


def test_base_colour_is_decoded_with_the_srgb_curve_and_data_is_not(tmp_path: Path) -> None:
    # 188 of 255 is 0.5029 in linear light (IEC 61966-2-1); a roughness of 188/255 stays 0.737.
    writer = GlbWriter()
    encoded, pixels = cv2.imencode(".png", np.full((2, 2, 3), 188, np.uint8))
    assert encoded
    texture = {"index": 0}
    writer.square({"pbrMetallicRoughness": {"baseColorTexture": texture, "metallicRoughnessTexture": texture, "roughnessFactor": 0.5}})
    writer.json |= {"images": [{"bufferView": writer.view(pixels.tobytes()), "mimeType": "image/png"}]}
    writer.json |= {"textures": [{"source": 0, "sampler": 0}], "samplers": [{"wrapS": 33071, "wrapT": 33648}]}
    material = load_glb(writer.write(tmp_path / "square.glb")).meshes[0].material
    assert material.base_color_texture is not None
    assert material.metallic_roughness_texture is not None
    assert np.allclose(material.base_color_texture.texels, 0.5029, atol=1e-4)
    assert np.allclose(material.metallic_roughness_texture.texels, 188 / 255)
    assert float(srgb_to_linear(np.array([188 / 255], np.float32))[0]) == pytest.approx(0.5029, abs=1e-4)
    assert material.base_color_texture.wrap == ("clamp", "mirror")
    assert (material.roughness, material.metallic) == (0.5, 1.0)


def test_unlit_mask_double_sided_and_specular(tmp_path: Path) -> None:
    writer = GlbWriter()
    extensions = {"KHR_materials_unlit": {}, "KHR_materials_specular": {"specularFactor": 0.25}, "KHR_materials_ior": {"ior": 1.33}}
    pbr = {"baseColorFactor": [0.1, 0.2, 0.3, 0.6]}
    writer.square({"alphaMode": "MASK", "alphaCutoff": 0.7, "doubleSided": True, "pbrMetallicRoughness": pbr, "extensions": extensions})
    scene = load_glb(writer.write(tmp_path / "square.glb"))
    material = scene.meshes[0].material
    assert (material.alpha_mode, material.alpha_cutoff, material.double_sided, material.unlit) == ("MASK", 0.7, True, True)
    assert material.dielectric_f0[0] == pytest.approx(0.25 * (0.33 / 2.33) ** 2)
    assert EmbreeRaycaster().render(in_front(scene), CAMERA).alpha.max() == 0.0  # 0.6 is below the cutoff
    writer.json["materials"][0]["alphaCutoff"] = 0.5
    rgb = EmbreeRaycaster().render(in_front(load_glb(writer.write(tmp_path / "square.glb"))), CAMERA).rgb[20, 20]
    assert np.allclose(rgb, [0.1, 0.2, 0.3], rtol=1e-6)


def test_vertex_colours_texture_transform_and_second_coordinates(tmp_path: Path) -> None:
    # Colour = factor x texture x vertex colour. The texture's left half is black; shifted by half a picture and read through
    # the second set of coordinates (all 0.25, so 0.75 after the shift) it shows the white half everywhere.
    writer = GlbWriter()
    _, pixels = cv2.imencode(".png", np.repeat(np.array([[0, 0, 255, 255]], np.uint8), 2, axis=0))
    colors = np.array([[128, 255, 0, 255]] * 4, np.uint8)
    attributes = {"COLOR_0": writer.accessor(colors, "VEC4", normalized=True)}
    attributes["TEXCOORD_1"] = writer.accessor(np.full((4, 2), 0.25, np.float32), "VEC2")
    texture = {"index": 0, "texCoord": 1, "extensions": {"KHR_texture_transform": {"offset": [0.5, 0.0]}}}
    writer.square({"pbrMetallicRoughness": {"baseColorTexture": texture}, "extensions": {"KHR_materials_unlit": {}}}, **attributes)
    writer.json |= {"images": [{"bufferView": writer.view(pixels.tobytes()), "mimeType": "image/png"}], "textures": [{"source": 0}]}
    rgb = EmbreeRaycaster().render(in_front(load_glb(writer.write(tmp_path / "square.glb"))), CAMERA).rgb[15:25, 15:25]
    assert np.allclose(rgb, [128 / 255, 1.0, 0.0], atol=1e-6)


def test_lights_shine_along_minus_z_of_their_node_and_scenes_stand_on_a_point(tmp_path: Path) -> None:
    writer = GlbWriter()
    writer.square()
    spot = {"type": "spot", "intensity": 20.0, "color": [1.0, 0.5, 0.25], "range": 9.0}
    cone = {"spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.6}}
    writer.json["extensions"] = {"KHR_lights_punctual": {"lights": [spot | cone]}}
    # Turned by -90 degrees about x: -z becomes -y, down in glTF, which is +y here.
    half = float(np.sqrt(0.5))
    lamp = {"translation": [1.0, 2.0, 3.0], "rotation": [-half, 0, 0, half], "extensions": {"KHR_lights_punctual": {"light": 0}}}
    writer.json["nodes"].append(lamp)
    writer.json["scenes"] = [{"nodes": [0, 1]}]
    (light,) = load_glb(writer.write(tmp_path / "lamp.glb")).lights
    assert np.allclose(light.position_m, [1, -2, -3])
    assert np.allclose(light.direction, [0, 1, 0], atol=1e-7)
    assert (light.kind, light.rgb, light.range_m) == ("spot", pytest.approx((20.0, 10.0, 5.0)), pytest.approx(9.0))
    assert (light.inner_cone_rad, light.outer_cone_rad) == (0.2, 0.6)
    scene = load_glb(writer.write(tmp_path / "stands.glb"))
    low, high = scene.transformed(world_from_scene_placing(scene, (1.0, 0.5, 3.0), height_m=0.2, turn_rad=np.pi / 2)).bounds_m
    assert np.allclose(low, [1.0, 0.3, 2.9])
    assert np.allclose(high, [1.0, 0.5, 3.1])


def animated_square(path: Path, interpolation: str, channel: str, times: list[float], values: np.ndarray) -> GltfAsset:
    writer = GlbWriter()
    writer.square()
    kind = "VEC4" if channel == "rotation" else "VEC3"
    input_, output = writer.accessor(np.array(times, np.float32), "SCALAR"), writer.accessor(values.astype(np.float32), kind)
    sampler = {"input": input_, "output": output, "interpolation": interpolation}
    target = {"sampler": 0, "target": {"node": 0, "path": channel}}
    writer.json["animations"] = [{"name": "go", "samplers": [sampler], "channels": [target]}]
    return GltfAsset(writer.write(path))


def test_animation_is_sampled_linearly_stepwise_by_splines_and_the_short_way(tmp_path: Path) -> None:
    way = np.array([[0, 0, 0], [2, 0, 0], [2, 4, 0]])

    def middle(asset: GltfAsset, time_s: float) -> np.ndarray:
        return asset.scene_at(time_s).meshes[0].positions_m.mean(0)

    linear = animated_square(tmp_path / "a.glb", "LINEAR", "translation", [0.0, 1.0, 2.0], way)
    assert linear.animation_durations_s == {"go": 2.0}
    for time_s, place_m in ((0.25, [0.5, 0, 0]), (1.5, [2, -2, 0]), (-1.0, [0, 0, 0]), (9.0, [2, -4, 0])):
        assert np.allclose(middle(linear, time_s), place_m)
    step = animated_square(tmp_path / "b.glb", "STEP", "translation", [0.0, 1.0, 2.0], way)
    assert np.allclose(middle(step, 0.99), [0, 0, 0])
    assert np.allclose(middle(step, 1.0), [2, 0, 0])
    # Hermite with tangents 0: the middle of a segment is the mean, a quarter of it 10/64 of the way (3 t^2 - 2 t^3).
    zero = np.zeros(3)
    bent = np.array([zero, way[0], zero, zero, way[1], zero])
    spline = animated_square(tmp_path / "c.glb", "CUBICSPLINE", "translation", [0.0, 1.0], bent)
    assert np.allclose(middle(spline, 0.5), [1, 0, 0])
    assert np.allclose(middle(spline, 0.25), [2 * 10 / 64, 0, 0])
    # From 0 to 90 degrees about glTF's z (given with the other sign of the quaternion): 30 degrees after a third.
    half = np.pi / 4
    turn = np.array([[0, 0, 0, 1], [0, 0, -np.sin(half), -np.cos(half)]])
    asset = animated_square(tmp_path / "turn.glb", "LINEAR", "rotation", [0.0, 1.0], turn)
    corner = asset.scene_at(1 / 3).meshes[0].positions_m[list(SQUARE.ravel()).index(1)]
    angle = np.radians(45 + 30)
    assert np.allclose(corner, np.sqrt(2) * np.array([np.cos(angle), -np.sin(angle), 0]), atol=1e-6)
    mirror = animated_square(tmp_path / "mirror.glb", "LINEAR", "scale", [0.0], np.array([[-1, 1, 1]])).scene_at(0.0).meshes[0]
    a, b, c = mirror.positions_m[mirror.triangles[0]]
    assert np.cross(b - a, c - a)[2] < 0
    assert np.allclose(mirror.normals, [0, 0, -1])


def test_skin_moves_vertices_with_their_joints(tmp_path: Path) -> None:
    # Two joints; the second is moved up by 1. Vertices weighted 0, 1/2 and 1 to it move by 0, 1/2 and 1; the mesh node's own
    # transform must not count.
    writer = GlbWriter()
    weights = np.array([[1, 0, 0, 0], [0.5, 0.5, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0]], np.float32)
    joints = np.tile(np.array([0, 1, 0, 0], np.uint8), (4, 1))
    writer.square(None, JOINTS_0=writer.accessor(joints, "VEC4"), WEIGHTS_0=writer.accessor(weights, "VEC4"))
    bind = np.stack([np.eye(4), np.eye(4)]).astype(np.float32)
    bind[1, 3, :3] = [0, -1, 0]  # column-major: the inverse of a joint that rests at y = 1
    writer.json["skins"] = [{"joints": [1, 2], "inverseBindMatrices": writer.accessor(bind.reshape(2, 16), "MAT4")}]
    writer.json["nodes"] = [{"mesh": 0, "skin": 0, "translation": [50, 0, 0]}, {"children": [2]}, {"translation": [0, 2, 0]}]
    writer.json["scenes"] = [{"nodes": [0, 1]}]
    mesh = load_glb(writer.write(tmp_path / "skin.glb")).meshes[0]
    moved = (CORNERS + np.array([[0, 0, 0], [0, 0.5, 0], [0, 1, 0], [0, 1, 0]]))[SQUARE.ravel()] * [1, -1, 1]
    assert np.allclose(mesh.positions_m, moved)


def test_broken_and_unsupported_files_say_what_to_do(tmp_path: Path) -> None:
    refused("check the path", load_glb, tmp_path / "missing.glb")
    (tmp_path / "noise.glb").write_bytes(b"not a model at all, but long enough")
    refused("export it again", load_glb, tmp_path / "noise.glb")
    writer = GlbWriter()
    writer.square()
    writer.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    refused("KHR_draco_mesh_compression", load_glb, writer.write(tmp_path / "draco.glb"))
    writer = GlbWriter()
    writer.square()
    writer.json["accessors"][0]["count"] = 4000
    refused("cut short", load_glb, writer.write(tmp_path / "short.glb"))


JUNK = (None, -1, 10**9, "x", [], {}, 1.5)


def _places(part: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    keys = part.keys() if isinstance(part, dict) else range(len(part)) if isinstance(part, list) else ()
    return [each for key in keys for each in [(*path, key), *_places(part[key], (*path, key))]]


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # bytes of something else may be any number
def test_any_wrong_value_is_refused_in_words(tmp_path: Path, shared_data: Path) -> None:
    stored = (shared_data / "objects" / "Fox.glb").read_bytes()
    length = struct.unpack_from("<I", stored, 12)[0]
    text, rest = stored[20 : 20 + length], stored[20 + length :]
    rng, path, refusals = np.random.default_rng(0), tmp_path / "wrong.glb", []
    every = _places(json.loads(text))
    for place in (every[number] for number in rng.permutation(len(every))[:60]):
        whole = json.loads(text)
        part = whole
        for key in place[:-1]:
            part = part[key]
        part[place[-1]] = JUNK[rng.integers(len(JUNK))]
        wrong = json.dumps(whole).encode()
        path.write_bytes(stored[:12] + struct.pack("<I4s", len(wrong), b"JSON") + wrong + rest)
        for read in (lambda: load_glb(path, 0.1), lambda: GltfAsset(path).animation_durations_s):
            try:
                read()
            except InputError as reason:
                refusals.append(str(reason))
    assert len(refusals) > 10  # every other exception fails
    primitive, channel = ("meshes", 0, "primitives", 0), ("animations", 0, "channels", 0)
    numbers = ((*primitive, "attributes", "POSITION"), (*primitive, "material"), (*channel, "sampler"), (*channel, "target", "node"))
    for place in (*numbers, ("bufferViews", 0, "buffer")):
        whole = json.loads(text)
        functools.reduce(lambda part, key: part[key], place[:-1], whole)[place[-1]] = -1
        wrong = json.dumps(whole).encode()
        path.write_bytes(stored[:12] + struct.pack("<I4s", len(wrong), b"JSON") + wrong + rest)
        with pytest.raises(InputError, match="no number -1"):
            load_glb(path, 0.1)


@pytest.fixture(scope="module")
def sky() -> Environment:
    """A small map with a bright side, so that wrong normals would show."""
    rows = np.linspace(1.5, 0.2, 32, dtype=np.float32)
    return Environment(np.ascontiguousarray(np.broadcast_to(rows[:, None, None], (32, 64, 3))))


@pytest.mark.parametrize("name", OBJECTS)
def test_real_objects_render(shared_data: Path, sky: Environment, name: str) -> None:
    scene = load_glb(shared_data / "objects" / f"{name}.glb").without_lights()
    low, high = scene.bounds_m
    scene = scene.transformed(world_from_scene_placing(scene, (0.0, 0.4, 2.0), height_m=float((high - low)[1] / (high - low).max())))
    layer = EmbreeRaycaster().render(scene.with_environment(sky), Camera(160, 90, (140.0, 138.0), (81.0, 44.0)))
    assert 0.02 < layer.alpha.mean() < 0.9
    assert np.isfinite(layer.rgb).all()
    assert layer.rgb.min() >= 0
    assert 0.01 < layer.rgb[layer.alpha == 1].mean() < 3.0
    depth_m = layer.depth_m[layer.alpha > 0]
    low, high = scene.bounds_m
    assert low[2] - 1e-4 <= depth_m.min()
    assert depth_m.max() <= high[2] + 1e-4


def test_fox_runs(shared_data: Path) -> None:
    asset = GltfAsset(shared_data / "objects" / "Fox.glb")
    assert set(asset.animation_durations_s) == {"Survey", "Walk", "Run"}
    duration_s = asset.animation_durations_s["Run"]
    poses = [asset.scene_at(duration_s * share, "Run") for share in (0.0, 0.25, 0.5)]
    points = [pose.meshes[0].positions_m for pose in poses]
    # A fox of about 150 units that runs on the spot: limbs move by several units, the whole stays a fox.
    assert np.linalg.norm(points[1] - points[0], axis=1).max() > 5.0
    for pose in poses:
        low, high = pose.bounds_m
        assert (high - low > [15, 50, 100]).all()
        assert (high - low < [60, 120, 220]).all()
        assert high[1] == pytest.approx(0.0, abs=8.0)  # its paws near the ground
    # Torn skin would leave long thin triangles: no edge is longer than a third of the fox.
    for corners in points:
        triangles = corners.reshape(-1, 3, 3)
        assert np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max() < 55.0
    refused("Survey", asset.scene_at, 0.0, "Jump")
