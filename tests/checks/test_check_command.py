"""`mrbokeh check`: a clean composite passes, and every defect planted in it on purpose is found and named."""

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mrbokeh.checks.checked_picture import Storage
from mrbokeh.checks.picture_checks import reach_of_sharp
from mrbokeh.commands.check import app
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import plate_of
from mrbokeh.demo.plan import DATA
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.exr_io import AP1, ExrPart, rec709_from_chromaticities, write_exr
from mrbokeh.images.image_io import read_layer, write_image, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack
from mrbokeh.system.errors import InputError
from mrbokeh.video.writer import VideoWriter
from tests.support.command_line import mrbokeh
from tests.support.refusals import refused

LENS = Lens(50.0, 2.0, 1.0, 2.2)
SIZE = (48, 72)


def photo(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.05, 0.9, (*SIZE, 3)).astype(np.float32)


def ball() -> Layer:
    """A bright square behind the focus, 7 px of blur, far from the border."""
    alpha = np.zeros(SIZE, np.float32)
    alpha[18:30, 28:44] = 1.0
    return Layer(alpha[..., None] * np.array([2.0, 0.5, 0.25], np.float32), alpha, np.where(alpha > 0, 1.2, np.inf).astype(np.float32))


def blurred() -> Layer:
    return ScatterReference(threads=1).render([ball()], LENS)


def composite(plate_rgb: np.ndarray) -> np.ndarray:
    return OverPhotograph().insert(plate_of(plate_rgb, LENS), [ball()], ScatterReference(threads=1)).rgb


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    paths = {name: tmp_path / f"{name}.exr" for name in ("plate", "virtual", "sharp", "out")}
    write_image(paths["plate"], photo(), half=False)
    write_layer(paths["virtual"], blurred(), half=False)
    write_layer(paths["sharp"], ball(), half=False)
    write_image(paths["out"], composite(photo()), half=False)
    write_lens(tmp_path / "lens.json", LENS)
    return {**paths, "lens": tmp_path / "lens.json", "map": tmp_path / "leaks.png"}


def run(*arguments: object, expected: int) -> str:
    result = CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == expected, result.output
    return result.output


def found_by(*arguments: object, expected: int) -> dict:
    """The figures of `mrbokeh check ... --json`."""
    done = mrbokeh("check", *arguments, "--json")
    assert done.returncode == expected, done.stderr
    return json.loads(done.stdout)["figures"]


def checked(files: dict[str, Path], expected: int, *more: object) -> dict:
    """The JSON of a check of out.exr against everything that is known."""
    layers = ("--virtual", files["virtual"], "--sharp", files["sharp"], "--leaks", files["map"])
    document = found_by(files["out"], "--against", files["plate"], *layers, *more, expected=expected)
    assert document["clean"] is (expected == 0)
    return document


def kinds(document: dict) -> set[str]:
    return {each["check"] for each in document["findings"]}


def test_a_clean_composite_has_no_findings_in_half_float_either(files: dict[str, Path]) -> None:
    document = checked(files, 0)
    assert document["findings"] == [] and document["skipped"] == {} and not files["map"].exists()
    assert document["measures"]["largest light after over before"] == pytest.approx(1.0, abs=1e-3)
    write_image(files["out"], composite(photo()), half=True)
    checked(files, 0)
    text = run(files["out"], expected=0)
    assert "not checked: leak" in text and "not checked: energy" in text


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bit_files_are_compared_code_by_code(files: dict[str, Path], tmp_path: Path, suffix: str) -> None:
    files["out"] = tmp_path / f"out{suffix}"
    picture = composite(photo())
    write_image(files["out"], picture)
    checked(files, 0)
    picture[2, 3] *= 1.001
    write_image(files["out"], picture)
    assert kinds(checked(files, 1)) == {"leak"}


def test_nan_and_infinity_are_found_where_they_are(files: dict[str, Path]) -> None:
    picture = composite(photo())
    picture[20, 30, 1], picture[21, 31, 0] = np.nan, np.inf
    write_image(files["out"], picture, half=False)
    found = [each for each in checked(files, 1)["findings"] if each["check"] == "nan"]
    assert len(found) == 1 and found[0]["value"] == 2 and "30,20" in found[0]["text"]


def test_alpha_out_of_range_and_negative_light_are_found_but_not_where_the_plate_has_it_too(files: dict[str, Path]) -> None:
    layer = blurred()
    for alpha, words in ((1.01, "above 1"), (-0.01, "below 0")):
        layer.alpha[24, 36] = alpha
        write_layer(files["virtual"], layer, half=False)
        found = [each for each in checked(files, 1)["findings"] if each["check"] == "alpha"]
        assert len(found) == 1 and words in found[0]["text"] and "layer virtual" in found[0]["where"]
        assert found[0]["value"] == pytest.approx(alpha, abs=1e-6)
    write_layer(files["virtual"], blurred(), half=False)
    strong_green = photo()
    strong_green[2, 2, 0] = -0.05
    write_image(files["plate"], strong_green, half=False)
    write_image(files["out"], composite(strong_green), half=False)
    files["map"].unlink(missing_ok=True)
    checked(files, 0)
    picture = composite(strong_green)
    picture[24, 36, 2] = -0.02
    write_image(files["out"], picture, half=False)
    found = checked(files, 1)["findings"]
    assert [each["check"] for each in found] == ["negative"] and found[0]["value"] == pytest.approx(-0.02, abs=1e-6)


def test_rounding_in_other_primaries_is_no_negative_light(tmp_path: Path) -> None:
    """Pure Rec.709 colours of up to 8 in ACEScg and half floats: their dark channels come back below 0, by thousandths at most."""
    pure = np.eye(3, dtype=np.float64)[np.random.default_rng(2).integers(0, 3, SIZE)] * np.linspace(1.0, 8.0, SIZE[1])[:, None]
    write_image(tmp_path / "plate.exr", pure.astype(np.float32), half=False)
    matrix = rec709_from_chromaticities(AP1)
    assert matrix is not None
    for dark, code in ((0.0, 0), (-0.2, 1)):
        pure[4, 4, pure[4, 4].argmin()] = dark
        coded = np.linalg.solve(matrix, pure.reshape(-1, 3).T).T.reshape(pure.shape).astype(np.float16)
        planes = {name: np.ascontiguousarray(coded[..., i]) for i, name in enumerate("RGB")}
        write_exr(tmp_path / "aces.exr", ExrPart(planes, attributes={"chromaticities": AP1}))
        assert read_layer(tmp_path / "aces.exr").rgb.min() < -5e-4
        found = found_by(tmp_path / "aces.exr", "--against", tmp_path / "plate.exr", expected=code)
        assert kinds(found) == ({"negative"} if code else set())


@pytest.mark.parametrize("factor", [1.02, 0.97])
def test_light_made_or_lost_in_the_blur_is_found(files: dict[str, Path], factor: float) -> None:
    layer = blurred()
    write_layer(files["virtual"], replace(layer, rgb=layer.rgb * np.float32(factor)), half=False)
    found = checked(files, 1)["findings"]
    assert [each["check"] for each in found] == ["energy"] and found[0]["value"] == pytest.approx(factor, abs=2e-3)
    checked(files, 0, "--energy-tolerance", 0.04)


def test_light_made_or_lost_is_found_but_not_what_leaves_the_frame(files: dict[str, Path]) -> None:
    layer = Layer(np.roll(ball().rgb, 28, axis=1), np.roll(ball().alpha, 28, axis=1), np.roll(ball().depth_m, 28, axis=1))
    write_layer(files["sharp"], layer, half=False)
    after = ScatterReference(threads=1).render([layer], LENS)
    write_layer(files["virtual"], after, half=False)
    write_image(files["out"], (1 - after.alpha[..., None]) * photo() + after.rgb, half=False)
    assert after.rgb.sum() < 0.97 * layer.rgb.sum()
    checked(files, 0)
    reached, lit = reach_of_sharp(ball(), LENS), blurred().alpha > 0
    assert not (lit & ~reached).any()
    radius_px = float(abs(LENS.coc_px(1.2, SIZE[1]))) / 2
    columns = np.flatnonzero(reached[24])
    assert columns[0] == pytest.approx(28 - radius_px - 1.5, abs=1.0) and columns[-1] == pytest.approx(43 + radius_px + 1.5, abs=1.0)


def test_what_the_photograph_hides_is_not_lost_in_a_composite_of_a_raw_file(tmp_path: Path) -> None:
    """A cake behind a ball of the desk, over a RAW file: its pixels are half floats in the EXR, and the plate is developed again."""
    photo, depth = (DATA / "raw_stack" / name for name in ("view_0/slice_02.dng", "truth/view_0/depth.exr"))
    cake = ("--object", DATA / "objects" / "cakeBirthday.glb", "--at-pixel", "190,265", "--height", "0.1", "--pitch", "10")
    assert mrbokeh("composite", photo, "--depth", depth, *cake, "--out", tmp_path / "cake.exr").returncode == 0
    document = found_by(tmp_path / "cake.exr", "--against", photo, expected=0)
    assert document["measures"]["smallest light after over before"] < 0.9 and document["skipped"] == {}


def test_pixels_changed_out_of_reach_are_counted_and_mapped(files: dict[str, Path]) -> None:

    picture = composite(photo())
    picture[40:43, 5:9] += np.float32(1e-4)
    write_image(files["out"], picture, half=False)
    document = checked(files, 1)
    assert kinds(document) == {"leak"} and document["findings"][0]["text"].startswith("12 pixels")
    shown = cv2.imread(str(files["map"]), cv2.IMREAD_UNCHANGED)
    expected = np.zeros(SIZE, np.uint8)
    expected[40:43, 5:9] = 255
    np.testing.assert_array_equal(shown, expected)
    checked(files, 0, "--tolerance", 0.01)


def test_the_lens_tells_the_reach_where_the_blurred_layer_is_not_kept(files: dict[str, Path]) -> None:
    settings = ("--against", files["plate"], "--sharp", files["sharp"], "--lens", files["lens"])
    run(files["out"], *settings, expected=0)
    picture = composite(photo())
    picture[24, 60] = 0.5
    write_image(files["out"], picture, half=False)
    assert kinds(found_by(files["out"], *settings, expected=1)) == {"leak"}
    refused("--sharp", run, files["out"], "--lens", files["lens"], expected=2)


def test_layered_exr_brings_its_layers(files: dict[str, Path]) -> None:
    rgb, layers = composite(photo()), {"virtual": blurred(), "sharp": ball()}
    channels = {c: rgb[..., i] for i, c in enumerate("RGB")}
    for name, layer in layers.items():
        channels |= {f"{name}.{c}": layer.rgb[..., i] for i, c in enumerate("RGB")} | {f"{name}.A": layer.alpha}
    write_exr(files["out"], ExrPart(channels))
    assert found_by(files["out"], "--against", files["plate"], expected=0)["skipped"] == {}
    channels["virtual.A"] = channels["virtual.A"] * 1.5
    write_exr(files["out"], ExrPart(channels))
    assert kinds(found_by(files["out"], "--against", files["plate"], expected=1)) == {"alpha", "energy"}


def test_what_cannot_be_read_is_one_sentence(files: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "broken.exr").write_bytes(b"not a picture")
    (tmp_path / "empty").mkdir()
    for path in ("broken.exr", "empty", "absent.png"):
        with pytest.raises(InputError):
            run(tmp_path / path, expected=2)
    write_image(tmp_path / "small.exr", photo()[:20])
    refused("its plate 72x20 px", run, files["out"], "--against", tmp_path / "small.exr", expected=2)


def test_codes_are_compared_as_if_all_were_encoded() -> None:
    """The quick way leaves out pixels that cannot differ; the plain one encodes them all."""
    rng = np.random.default_rng(1)
    plate = rng.uniform(-0.1, 1.2, (*SIZE, 3)).astype(np.float32)
    rgb = plate + rng.normal(0, 0.01, plate.shape).astype(np.float32) * rng.integers(0, 2, (*SIZE, 1)).astype(np.float32)
    shown, stored = (np.clip(linear_to_srgb(each), 0, 1) for each in (rgb, plate))
    for step in (1.5 / 65535, 1.5 / 255, 12 / 255):
        np.testing.assert_array_equal(Storage(False, step).changed(rgb, plate), (np.abs(shown - stored) > step).any(axis=2))


def sequence(folder: Path, frames: list[np.ndarray], first: int = 1) -> Path:
    for index, rgb in enumerate(frames):
        write_image(folder / f"shot.{first + index:04d}.exr", rgb, half=False)
    return folder


def noisy_plates(count: int = 8) -> list[np.ndarray]:
    """A photograph with grain of 0.002."""
    rng = np.random.default_rng(4)
    return [(photo() + rng.normal(0, 0.002, (*SIZE, 3))).astype(np.float32) for _ in range(count)]


def report_of(out: Path, plate: Path, expected: int, *more: object) -> dict:
    return found_by(out, "--against", plate, *more, expected=expected)


def test_a_steady_sequence_passes_and_a_flickering_one_does_not(tmp_path: Path) -> None:
    plates = noisy_plates()
    layer = blurred()
    light = [(1 - layer.alpha[..., None]) * each for each in plates]
    plate = sequence(tmp_path / "plate", plates)
    steady = report_of(sequence(tmp_path / "steady", [each + layer.rgb for each in light]), plate, 0)
    # Grain of standard deviation s changes by 2 s / sqrt(pi) on average from frame to frame.
    assert steady["measures"]["flicker of the plate"] == pytest.approx(2 * 0.002 / np.sqrt(np.pi), rel=0.05)
    shaken = [each + layer.rgb * np.float32(1 + 0.2 * (index % 2)) for index, each in enumerate(light)]
    found = report_of(sequence(tmp_path / "shaken", shaken), plate, 1)
    assert kinds(found) == {"flicker"}
    # As `video` names what it wrote.
    report_of(tmp_path / "shaken" / "shot.%04d.exr", plate, 0, "--flicker-limit", 0.5)


def test_layers_may_come_one_for_each_picture(tmp_path: Path) -> None:
    plates, layer = noisy_plates(3), blurred()
    made = [(1 - layer.alpha[..., None]) * each + layer.rgb for each in plates]
    plate, out = sequence(tmp_path / "plate", plates), sequence(tmp_path / "out", made)
    for index in range(3):
        write_layer(tmp_path / "virtual" / f"v.{index}.exr", layer, half=False)
    report_of(out, plate, 0, "--virtual", tmp_path / "virtual")
    nothing = replace(layer, rgb=0 * layer.rgb, alpha=0 * layer.alpha)
    write_layer(tmp_path / "virtual" / "v.1.exr", nothing, half=False)
    found = report_of(out, plate, 1, "--virtual", tmp_path / "virtual")
    assert [(each["check"], each["where"]) for each in found["findings"]] == [("leak", "shot.0002.exr")]
    # By number, as `video --virtual-only` names them.
    named = [(tmp_path / "virtual" / f"v.{index}.exr").replace(tmp_path / f"layer.{1 + index:04d}.exr") for index in range(3)]
    found = report_of(out, plate, 1, "--virtual", tmp_path / "layer.%04d.exr")
    assert [(each["check"], each["where"]) for each in found["findings"]] == [("leak", "shot.0002.exr")]
    for index in range(3):
        named[index].replace(tmp_path / "virtual" / f"v.{index}.exr")
    (tmp_path / "virtual" / "v.2.exr").unlink()
    refused("one for each", run, out, "--against", plate, "--virtual", tmp_path / "virtual", expected=2)


def test_one_jump_a_frozen_frame_missing_and_damaged_ones_are_found(tmp_path: Path) -> None:
    plates = noisy_plates(12)
    plate = sequence(tmp_path / "plate", plates)
    jumped = [each.copy() for each in plates]
    for each in jumped[6:]:
        each[20:40, 20:50] *= np.float32(0.9)
    found = report_of(sequence(tmp_path / "jumped", jumped), plate, 1, "--flicker-limit", 0.003)
    assert [(each["check"], each["where"]) for each in found["findings"]] == [("pop", "shot.0007.exr")]
    found = report_of(sequence(tmp_path / "frozen", [*plates[:5], plates[4], *plates[6:]]), plate, 1)
    assert [(each["check"], each["where"]) for each in found["findings"]] == [("frozen", "shot.0006.exr")]
    plate, out = (sequence(tmp_path / name, noisy_plates(6), first=101) for name in ("numbered", "out"))
    (out / "shot.0103.exr").unlink()
    (out / "shot.0106.exr").unlink()
    whole = (out / "shot.0105.exr").read_bytes()
    (out / "shot.0105.exr").write_bytes(whole[: len(whole) // 2])
    found = report_of(out, plate, 1)
    assert kinds(found) == {"missing", "damaged"} and found["pictures"] == 3
    assert any("103, 106" in each["text"] for each in found["findings"])


def film(path: Path, frames: list[np.ndarray], times: list[float]) -> Path:
    with VideoWriter(path, SIZE[1], SIZE[0], Fraction(25), Fraction(1, 1000)) as writer:
        for rgb, time_s in zip(frames, times, strict=True):
            writer.write(rgb, time_s)
    return path


def test_films_are_paired_by_time(tmp_path: Path) -> None:
    plates, times = noisy_plates(10), [0.04 * index for index in range(10)]
    layer = blurred()
    made = [(1 - layer.alpha[..., None]) * each + layer.rgb for each in plates]
    write_layer(tmp_path / "virtual.exr", layer, half=False)
    plate = film(tmp_path / "plate.mkv", plates, times)
    known = ("--virtual", tmp_path / "virtual.exr")
    report_of(film(tmp_path / "whole.mkv", made, times), plate, 0, *known)
    holed = film(tmp_path / "holed.mkv", made[:4] + made[5:], times[:4] + times[5:])
    found = report_of(holed, plate, 1, *known)
    assert [each["check"] for each in found["findings"]] == ["missing"] and "the plate's frame 4" in found["findings"][0]["text"]
    part = film(tmp_path / "part.mkv", made[3:7], [time_s - times[3] for time_s in times[3:7]])
    report_of(part, plate, 0, "--frames", "3-6", *known)
    report_of(part, plate, 1, *known)
    # Called as `video --first-number` called them, every second, with layers by these numbers.
    for number in (1004, 1006):
        write_layer(tmp_path / f"layer.{number}.exr", layer, half=False)
    some = film(tmp_path / "some.mkv", made[3:7:2], [0.0, times[5] - times[3]])
    report_of(some, plate, 0, "--frames", "1004-1007x2", "--first-number", 1001, "--virtual", tmp_path / "layer.%04d.exr")


def test_slices_of_a_stack_are_checked_against_those_of_the_other(tmp_path: Path) -> None:
    for name in ("plate", "out"):
        folder = tmp_path / name
        slices = tuple(Slice(f"slice_{index}.exr", 1.0 + index) for index in range(3))
        for index, each in enumerate(slices):
            write_image(folder / each.path, photo(index), half=False)
        write_focal_stack(FocalStack(folder, slices))
    assert report_of(tmp_path / "out", tmp_path / "plate", 0)["pictures"] == 3
    (tmp_path / "out" / "slice_1.exr").unlink()
    assert kinds(report_of(tmp_path / "out", tmp_path / "plate", 1)) == {"missing"}
