"""Cryptomatte: the published hashes, mattes of a file written by the specification and of one by Blender, and layers per object."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.commands.composite import app as composite
from mrbokeh.commands.render import app as blur
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.layer import flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.stacks.exr_layers.cryptomatte import ObjectSplit, cryptomattes, id_bits, murmur3_32
from mrbokeh.stacks.exr_layers.render_channels import FlatRender, RenderChannels
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from tests.support.refusals import refused

HEIGHT, WIDTH = 6, 10
BLENDER = Path(__file__).parents[1] / "data" / "blender" / "render.0002.exr"
NAMES = ("near", "far", "flöte/1")


def as_float(bits: int) -> np.float32:
    return np.float32(struct.unpack("<f", struct.pack("<I", bits))[0])


@pytest.mark.parametrize(
    ("text", "hashed"),
    [("", 0), ("a", 0x3C2569B2), ("ab", 0x9BBFD75F), ("abc", 0xB3DD93FA), ("hello", 0x248BFA47), ("test", 0xBA6BD213)],
)
def test_murmur_hash_of_its_author(text: str, hashed: int) -> None:
    """Values of MurmurHash3_x86_32 with seed 0, for tails of 0 to 3 bytes."""
    assert murmur3_32(text.encode()) == hashed


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hello", 6.0705627102400005616e-17),
        ("cube", -4.08461912519e15),
        ("sphere", 2.79018604383e15),
        ("plane", 3.66557617593e-11),
        ("равнина", -1.3192631212399999468e-25),
        ("mädchen", 6.2361298211599995797e25),
    ],
)
def test_ids_of_the_reference_implementation(name: str, value: float) -> None:
    """cryptomatte_utilities_tests.py of Psyop's Cryptomatte: the IDs as floats."""
    assert as_float(id_bits(name)) == np.float32(value)


def test_ids_are_never_infinite_or_denormal() -> None:
    """Names whose hash has an exponent of zeros or ones get its lowest bit turned over, and nothing else."""
    names = [f"object{i}" for i in range(3000)]
    touched = [name for name in names if murmur3_32(name.encode()) >> 23 & 255 in (0, 255)]
    # 2 exponents of 256.
    assert 8 < len(touched) < 50
    for name in touched:
        assert id_bits(name) ^ murmur3_32(name.encode()) == 1 << 23
    bits = np.array([id_bits(name) for name in names], np.uint32)
    assert (np.abs(bits.view(np.float32)) >= np.finfo(np.float32).tiny).all() and np.isfinite(bits.view(np.float32)).all()


def coverages() -> dict[str, np.ndarray]:
    """near covers the left half and part of column 5, far the rest of it and on to column 8; the third is hidden behind in no pixel."""
    near, far = np.zeros((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)
    near[:, :5], near[:, 5], far[:, 5], far[:, 6:8], far[:, 8] = 1.0, 0.75, 0.25, 1.0, 0.5
    return {"near": near, "far": far}


def crypto_channels(name: str = "CryptoObject") -> dict[str, np.ndarray]:
    """Ranks by the specification: the larger coverage first, IDs as floats, 0 where nobody is."""
    planes = np.zeros((4, HEIGHT, WIDTH), np.float32)
    stacked = np.stack(list(coverages().values()))
    ids = np.array([id_bits(each) for each in coverages()], np.uint32).view(np.float32)
    order = np.argsort(-stacked, axis=0, kind="stable")
    for rank in range(2):
        covered = np.take_along_axis(stacked, order, axis=0)[rank]
        planes[2 * rank], planes[2 * rank + 1] = np.where(covered > 0, ids[order[rank]], 0), covered
    return {f"{name}00.{channel}": plane for channel, plane in zip("RGBA", planes, strict=True)}


def header(name: str = "CryptoObject", **changed: str) -> dict[str, str]:
    key = f"cryptomatte/{murmur3_32(name.encode()):08x}"[:19]
    entries = {"name": name, "hash": "MurmurHash3_32", "conversion": "uint32_to_float32"}
    entries |= {"manifest": json.dumps({each: f"{id_bits(each):08x}" for each in NAMES})}
    return {f"{key}/{what}": value for what, value in {**entries, **changed}.items() if value}


def beauty() -> dict[str, np.ndarray]:
    """near is red at 1 m, far green at 4 m; one depth per pixel, in the shared column that of far."""
    near, far = coverages().values()
    depth_m = np.where(near == 1, 1.0, np.where(far > 0, 4.0, 1e10)).astype(np.float32)
    return {"R": 0.9 * near, "G": 0.5 * far, "B": 0.1 * (near + far), "A": near + far, "Z": depth_m}


@pytest.fixture
def render(tmp_path: Path) -> Path:
    write_exr(tmp_path / "a.exr", ExrPart(beauty() | crypto_channels(), attributes=header()))
    return tmp_path / "a.exr"


def test_mattes_by_name(render: Path) -> None:
    (found,) = cryptomattes(RenderChannels.read(render)).values()
    assert found.name == "CryptoObject" and found.names == sorted(NAMES)
    for name, coverage in coverages().items():
        np.testing.assert_array_equal(found.matte(name), coverage)
    # Listed, but in no pixel.
    assert found.matte("flöte/1").max() == 0.0
    np.testing.assert_array_equal(found.covered, sum(coverages().values()))
    refused(r"'nearr' is not in the Cryptomatte CryptoObject: there are near", found.matte, "nearr")


def test_without_a_manifest_the_name_itself_is_hashed(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", ExrPart(beauty() | crypto_channels(), attributes=header(manifest="")))
    (found,) = cryptomattes(RenderChannels.read(tmp_path / "a.exr")).values()
    assert found.names == []
    np.testing.assert_array_equal(found.matte("far"), coverages()["far"])
    refused("no manifest", found.matte, "nobody")


def test_manifest_in_a_file_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "names.json").write_text(json.dumps({"renamed": f"{id_bits('near'):08x}"}))
    write_exr(tmp_path / "a.exr", ExrPart(beauty() | crypto_channels(), attributes=header(manifest="", manif_file="names.json")))
    (found,) = cryptomattes(RenderChannels.read(tmp_path / "a.exr")).values()
    np.testing.assert_array_equal(found.matte("renamed"), coverages()["near"])
    (tmp_path / "names.json").write_text("{")
    refused("manifest of the Cryptomatte CryptoObject cannot be read", cryptomattes, RenderChannels.read(tmp_path / "a.exr"))


def test_mattes_of_layers_are_written_into_what_is_made_of_them(tmp_path: Path) -> None:
    """By `composite` beside all layers, also in ACEScg, and by `render --alpha-out`: to the bit, so that names still select."""
    (tmp_path / "names.json").write_text(json.dumps({each: f"{id_bits(each):08x}" for each in NAMES}))
    entries = header(manifest="", manif_file="names.json")
    write_exr(tmp_path / "cg.exr", ExrPart(beauty() | crypto_channels(), attributes=entries))
    write_exr(tmp_path / "plate.exr", ExrPart(dict.fromkeys("RGB", np.zeros((HEIGHT, WIDTH), np.float32))))
    layer, lens = ("--layer", tmp_path / "cg.exr"), ("--focal-length", 50, "--f-number", 2, "--focus", 1, "--sensor-width", 36)
    (tmp_path / "out").mkdir()
    made = [tmp_path / "out" / f"{name}.exr" for name in ("plain", "aces", "blurred")]
    printed_by(composite, tmp_path / "plate.exr", *layer, *lens, "--out", made[0])
    printed_by(composite, tmp_path / "plate.exr", *layer, *lens, "--output-space", "ACEScg", "--out", made[1])
    printed_by(blur, *layer, *lens, "--alpha-out", "--out", made[2])
    for path in made:
        (found,) = cryptomattes(RenderChannels.read(path)).values()
        assert found.names == sorted(NAMES)
        for name, coverage in coverages().items():
            np.testing.assert_array_equal(found.matte(name), coverage)
    printed = printed_by(composite, tmp_path / "plate.exr", *layer, "--layer", tmp_path / "cg.exr", *lens, "--out", tmp_path / "two.exr")
    assert "has a Cryptomatte of the same name" not in printed, "the same file twice has nothing to choose"


def test_what_the_specification_does_not_know_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    half = crypto_channels() | {"CryptoObject00.R": np.zeros((HEIGHT, WIDTH), np.float16)}
    for channels, entries, message in (
        (crypto_channels(), header(hash="md5"), "expected hash MurmurHash3_32 of the Cryptomatte CryptoObject, got 'md5': write"),
        (half, header(), "stored as float16"),
        ({}, header(), "got none: write the render again"),
        (crypto_channels(), {}, "has none"),
    ):
        write_exr(path, ExrPart(beauty() | channels, attributes=entries))
        refused(message, cryptomattes, RenderChannels.read(path))


@pytest.mark.parametrize("objects", [("near", "far"), ("far",), ("near",)])
def test_layers_of_objects_give_the_render_again(render: Path, objects: tuple[str, ...]) -> None:
    picture = FlatRender().layers(render)[0]
    layers = ObjectSplit(objects).layers(render)
    assert len(layers) == len(objects) + 1
    again = flatten(layers)
    np.testing.assert_allclose(again.rgb, picture.rgb, atol=1e-6)
    np.testing.assert_allclose(again.alpha, picture.alpha, atol=1e-6)
    assert all(layer.alpha.min() >= 0.0 and layer.alpha.max() <= 1.0 + 1e-6 for layer in layers)


def test_each_object_has_its_own_depth_and_goes_by_it(render: Path) -> None:
    near, far, _ = ObjectSplit(("far", "near")).layers(render)
    # The shared column is stored at 4 m, but the red part of it is the near object's.
    assert (near.depth_m[near.alpha > 0] == 1.0).all() and (far.depth_m[far.alpha > 0] == 4.0).all()
    np.testing.assert_allclose(near.alpha, coverages()["near"], atol=1e-6)
    # Behind the near edge the far object is hidden, not thin: it fills all that is left.
    np.testing.assert_allclose(far.alpha[:, 5], 1.0, atol=1e-6)


def test_the_rest_left_out(render: Path) -> None:
    (only,) = ObjectSplit(("near",), with_rest=False).layers(render)
    np.testing.assert_allclose(only.alpha, coverages()["near"], atol=1e-6)


def test_light_of_nobody_is_kept_in_the_rest(tmp_path: Path) -> None:
    """A glow before the near object, where nothing covers and where something does, stays in front of nothing and is not lost."""
    glowing = beauty()
    glowing["B"] = glowing["B"] + np.float32(2.0)
    write_exr(tmp_path / "a.exr", ExrPart(glowing | crypto_channels(), attributes=header()))
    again = flatten(ObjectSplit(("near", "far")).layers(tmp_path / "a.exr"))
    np.testing.assert_allclose(again.rgb, FlatRender().layers(tmp_path / "a.exr")[0].rgb, atol=1e-6)


def test_choices_that_cannot_be(tmp_path: Path) -> None:
    refused("named once", ObjectSplit, ("near", "near"))
    both = beauty() | crypto_channels() | crypto_channels("CryptoMaterial")
    write_exr(tmp_path / "two.exr", ExrPart(both, attributes=header() | header("CryptoMaterial")))
    with pytest.raises(InputError, match="expected one Cryptomatte, got CryptoObject, CryptoMaterial"):
        ObjectSplit(("near",)).layers(tmp_path / "two.exr")


def test_blender_writes_what_we_read() -> None:
    """Blender 4.2 names its ranks with small letters and the key by itself; the manifest is Blender's, the hash ours."""
    (found,) = cryptomattes(RenderChannels.read(BLENDER)).values()
    assert found.name == "ViewLayer.CryptoObject" and found.names == ["cube", "sphere"]
    assert all(found.manifest[name] == id_bits(name) for name in found.names)
    # Both only shine, the cube (0.8, 0.1, 0.05), the ball (0.1, 0.6, 0.2): the picture is coverage times that, ray by ray.
    channels = read_exr(BLENDER)[0].channels
    for i, channel in enumerate("RGB"):
        shone = found.matte("cube") * (0.8, 0.1, 0.05)[i] + found.matte("sphere") * (0.1, 0.6, 0.2)[i]
        np.testing.assert_allclose(channels[f"ViewLayer.Combined.{channel}"], shone, atol=1e-6)
    np.testing.assert_allclose(channels["ViewLayer.Combined.A"], found.covered, atol=1e-6)
    assert ((found.covered > 0) & (found.covered < 1)).mean() > 0.02


def test_a_blender_render_split_by_its_objects() -> None:
    cube, ball, rest = ObjectSplit(("sphere", "cube")).layers(BLENDER)
    assert rest.alpha.max() < 1e-6
    # The cube ends before 2 m, the ball begins at 2.7 m (Z of its pixels); both meet in pixels on the cube's edge.
    assert cube.depth_m[cube.alpha > 0].max() < 2.0 and ball.depth_m[ball.alpha > 0].min() > 2.7
    assert ((cube.alpha > 0) & (cube.alpha < 1) & (ball.alpha > 0)).any()


def test_ranks_in_parts_of_their_own(tmp_path: Path) -> None:
    """Multi-part renders may keep a rank as a part with plain R, G, B and A; the picture is the part that is known as such."""
    plain = {name.rpartition(".")[2]: plane for name, plane in crypto_channels().items()}
    parts = [ExrPart(plain, "CryptoObject00", header()), ExrPart(beauty(), "beauty")]
    write_exr(tmp_path / "a.exr", parts)
    (found,) = cryptomattes(RenderChannels.read(tmp_path / "a.exr")).values()
    np.testing.assert_array_equal(found.matte("near"), coverages()["near"])
    near, far, _ = ObjectSplit(("near", "far")).layers(tmp_path / "a.exr")
    np.testing.assert_allclose(near.alpha, coverages()["near"], atol=1e-6)
    assert far.rgb[0, 7, 1] == np.float32(0.5)


def test_split_layers_blur_together() -> None:
    """All light that does not leave the frame arrives."""
    split = ObjectSplit(("cube", "sphere"), with_rest=False).layers(BLENDER)
    blurred = PolygonDifferences().render(split, Lens(35.0, 2.0, 2.0, 36.0))
    assert blurred.alpha.max() <= 1.0 + 1e-5
    # The ball behind the cube's edge is seen a little more or less by a wide lens: 2 % of the light.
    assert blurred.rgb.sum() == pytest.approx(flatten(split).rgb.sum(), rel=0.02)
