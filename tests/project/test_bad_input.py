"""Inputs that cannot be meant: one sentence with exit code 2 before any work, and nothing is written."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import write_image, write_layer
from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.stacks.focus_places import FocusLookup, parse_focus
from mrbokeh.video.clip import Frame, read_frames
from tests.support.command_line import mrbokeh
from tests.support.refusals import refused

TRANSFER = ("transfer", "photo.png", "--lens", "lens.json", "--depth", "sharp.exr", "--out", "out.exr")
NEW_LENS = ("lens", "new", "new.json", "--focal-length", "50", "--f-number", "2", "--focus", "1")
RENDER = ("render", "--rgb", "sharp.exr", "--depth", "sharp.exr", "--lens", "lens.json", "--out", "out.exr")
COMPOSITE = ("composite", "photo.png", "--lens", "lens.json", "--depth", "sharp.exr", "--out", "out.exr", "--layer", "layer.exr")


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a picture, its depth, a layer and a lens, and with files that are not what they should be."""
    monkeypatch.chdir(tmp_path)
    rgb, ones = np.full((24, 32, 3), 0.3, np.float32), np.ones((24, 32), np.float32)
    write_layer("sharp.exr", opaque(rgb, ones))
    write_layer("layer.exr", Layer(0.5 * rgb, 0.5 * ones, 2 * ones))
    write_layer("large.exr", Layer(np.tile(0.5 * rgb, (2, 2, 1)), np.tile(0.5 * ones, (2, 2)), np.tile(2 * ones, (2, 2))))
    write_image("photo.png", rgb)
    write_lens("lens.json", Lens(50.0, 2.0, 1.0, 36.0))
    write_exr("no_depth.exr", ExrPart({"Z": np.zeros((24, 32), np.float32)}))
    write_exr("alpha_7.exr", ExrPart(dict.fromkeys("RGBA", 7 * ones)))
    Path("loop.exr").symlink_to("loop.exr")
    Path("deep.json").write_text("[" * 100_000 + "]" * 100_000)
    Path("file").write_text("x")
    return tmp_path


def replaced(words: tuple[str, ...], option: str, value: str) -> tuple[str, ...]:
    at = words.index(option) + 1
    return (*words[:at], value, *words[at + 1 :])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (replaced(RENDER, "--rgb", "loop.exr"), "expected a picture at loop.exr, but it is a link to loop.exr, which leads nowhere"),
        ((*RENDER, "--f-number", "0"), "--f-number: expected a number above 0"),
        (
            ("composite", "photo.png", "--focus", "1", "--f-number", "2", "--layer", "layer.exr", "--out", "out.exr"),
            "unknown: focal length, sensor width): give --focal-length MM --sensor-width MM, or --lens",
        ),
        (replaced(RENDER, "--rgb", "."), "expected a picture at ., but it is a folder"),
        (replaced(RENDER, "--lens", "deep.json"), "brackets lie too deep"),
        (replaced(RENDER, "--depth", "no_depth.exr"), "expected metres above 0 in its depth, but the largest is 0"),
        (replaced(RENDER, "--out", "file/out.exr"), "file"),
        (replaced(RENDER, "--out", "/proc/out.exr"), "cannot write /proc/out.exr"),
        (("render", "--layer", "alpha_7.exr", "--lens", "lens.json", "--out", "out.exr"), "expected alpha from 0 to 1, but A goes from 7"),
        (replaced(COMPOSITE, "--layer", "large.exr"), "the virtual layer is 64x48 px but the photograph is 32x24 px"),
        ((*COMPOSITE, "--save-layer", "/proc/layer.exr"), "cannot write /proc/layer.exr"),
        ((*COMPOSITE, "--ocio", "file"), "--ocio file has no use by itself"),
        ((*COMPOSITE[:-2], "--object", "cake.glb", "--at", "0,0,0"), "in front of the lens, with Z above 0 m"),
        (
            ("transfer", "photo.png", "--lens", "lens.json", "--depth", "sharp.exr", "--stereo-cameras", "1,2", "--out", "out.exr"),
            "--stereo-cameras is for",
        ),
        (
            ("lens", "new", "new.json", "--focal-length", "50", "--f-number", "2", "--focus", "1", "--blades", "100000000"),
            "3 to 100 blades",
        ),
    ],
)
def test_it_is_refused_in_one_sentence(words: tuple[str, ...], told: str, there: Path) -> None:
    before = sorted(there.iterdir())
    done = mrbokeh(*words)
    assert done.returncode == 2 and told in done.stderr and "fault" not in done.stderr, done.stderr
    assert sorted(there.iterdir()) == before


def test_places_to_focus_on_have_a_largest_number() -> None:
    seen = FocusLookup(Lens(50.0, 2.0, 1.0, 36.0))
    assert len(parse_focus("1:2:1000", seen)) == 1000
    refused("at most 1000 places", parse_focus, "1:2:100000000", seen)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_clip_that_was_cut_off_is_told_once_its_pictures_were_given(suffix: str, tmp_path: Path) -> None:
    import av

    whole, cut = tmp_path / f"whole.{suffix}", tmp_path / f"cut.{suffix}"
    in_pieces = {"movflags": "frag_keyframe+empty_moov"} if suffix == "mp4" else {}
    rng = np.random.default_rng(0)
    with av.open(str(whole), "w", options=in_pieces) as container:
        stream = container.add_stream("libx264", rate=10, options={"g": "5"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(40):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rng.integers(0, 255, (48, 64, 3), np.uint8))))
        container.mux(stream.encode())
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert len(list(read_frames(whole))) == 40
    given: list[Frame] = []
    refused("the file is damaged or cut off", given.extend, read_frames(cut))
    assert 10 <= len(given) <= 25
