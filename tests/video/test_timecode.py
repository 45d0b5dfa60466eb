"""Timecode counted by hand and by SMPTE ST 12-1, and carried from plate to result, with what else a plate states."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mrbokeh.images.exr_io import ExrPart, header_of, read_exr, write_exr
from mrbokeh.images.image_io import read_image, read_layer, write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.stacks.exr_layers.cryptomatte import cryptomattes
from mrbokeh.stacks.exr_layers.render_channels import RenderChannels
from mrbokeh.video.picture_source import open_source
from mrbokeh.video.timecode import Timecode
from mrbokeh.video.writer import StreamFacts, VideoWriter
from tests.stacks.test_exr_layers_cryptomatte import beauty, coverages, crypto_channels, header
from tests.support.refusals import refused
from tests.support.video_files import video as run

NTSC = Fraction(30000, 1001)
FILM = Fraction(24000, 1001)


def test_dropped_numbers_keep_pace_with_the_clock() -> None:
    """17982 frames of 29.97 are ten minutes: 00:09:59;29 is followed by 00:10:00;00; the first minute ends with 29, then comes ;02."""
    start = Timecode.parsed("00:00:59;29", NTSC)
    assert start is not None and str(start.later(1)) == "00:01:00;02"
    assert str(Timecode(17982, 30, drops=True)) == "00:10:00;00" and str(Timecode(17981, 30, drops=True)) == "00:09:59;29"
    assert str(Timecode(2 * 3600 * 30000 // 1001, 30, drops=True)) == "02:00:00;00"  # two hours of the clock
    for count in (0, 1799, 1800, 17981, 17982, 107892, 215783):
        assert Timecode.parsed(str(Timecode(count, 30, drops=True)), NTSC) == Timecode(count, 30, drops=True)
    twice = Timecode.parsed("00:00:59;59", 2 * NTSC)
    assert twice is not None and str(twice.later(1)) == "00:01:00;04" and twice.to_exr() is None
    plain = Timecode.parsed("23:59:59:23", FILM)
    assert plain is not None and str(plain.later(1)) == "00:00:00:00"
    assert Timecode.parsed("10:00:00:24", FILM) is None and Timecode.parsed("soon", FILM) is None


@pytest.fixture
def options(tmp_path: Path) -> list[str]:
    alpha = np.zeros((48, 64), np.float32)
    alpha[20:28, 20:30] = 1.0
    write_layer(tmp_path / "cg.exr", Layer(np.dstack([alpha] * 3), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32)))
    write_lens(tmp_path / "lens.json", Lens(50.0, 8.0, 2.0, 36.0))
    return ["--lens", str(tmp_path / "lens.json"), "--layer", str(tmp_path / "cg.exr")]


@pytest.mark.parametrize("suffix", [".mov", ".mkv"])
def test_the_timecode_of_a_video_goes_on_into_video_and_exr(tmp_path: Path, options: list[str], suffix: str) -> None:
    clip, code = tmp_path / f"clip{suffix}", Timecode.parsed("10:20:30:22", FILM)
    with VideoWriter(clip, 64, 48, FILM, facts=StreamFacts(code)) as writer:
        for index in range(6):
            writer.write(np.full((48, 64, 3), 0.2, np.float32), float(index / FILM))
    source = open_source(clip)
    assert source.info.timecode == code and str(source.timecode_of(3)) == "10:20:31:01"
    run(clip, *options, "--frames", "2-5", "--out", tmp_path / "out.mov")
    assert str(open_source(tmp_path / "out.mov").info.timecode) == "10:20:31:00"
    run(clip, *options, "--frames", "2-5", "--first-number", 0, "--out", tmp_path / "out.%d.exr")
    told = [header_of(tmp_path / f"out.{index}.exr") for index in (2, 5)]
    assert [(each["timeCode"].hours, each["timeCode"].seconds, each["timeCode"].frame) for each in told] == [(10, 31, 0), (10, 31, 3)]
    assert told[0]["framesPerSecond"] == FILM


def test_what_an_exr_plate_states_goes_on_into_exr_and_video(tmp_path: Path, options: list[str]) -> None:
    """Each frame its own header, the overscan too; the rate needs no --rate, and another is refused."""
    import OpenEXR

    rng, window = np.random.default_rng(1), lambda *corners: tuple(np.array(each, np.int32) for each in corners)
    for index in range(3):
        code = OpenEXR.TimeCode(1, 2, 3, 4 + index, False, *[False] * 5, *[0] * 8)
        stated = {"timeCode": code, "framesPerSecond": Fraction(24), "pixelAspectRatio": 2.0, "slate": f"7-{index}"}
        stated |= {"displayWindow": window((0, 0), (63, 47)), "dataWindow": window((-4, -2), (67, 49))}
        planes = dict(zip("RGB", rng.random((3, 52, 72), np.float32), strict=True))
        write_exr(tmp_path / f"plate.{1001 + index}.exr", ExrPart(planes, attributes=stated))
    plate = tmp_path / "plate.%04d.exr"
    told = run(plate, *options, "--out", tmp_path / "out.%04d.exr")
    assert "has overscan (4, 2, 4, 2 px" in " ".join(told.split())
    for index in range(3):
        found, before = header_of(tmp_path / f"out.{1001 + index}.exr"), header_of(tmp_path / f"plate.{1001 + index}.exr")
        for name in ("framesPerSecond", "pixelAspectRatio", "slate"):
            assert found[name] == before[name]
        assert str(found["timeCode"]) == str(before["timeCode"])
        (part,), (old,) = (read_exr(tmp_path / f"{name}.{1001 + index}.exr", overscan=True) for name in ("out", "plate"))
        assert part.margins_px == (4, 2, 4, 2)
        np.testing.assert_allclose(part.channels["G"][:2], old.channels["G"][:2], atol=2**-11)
        assert part.attributes["chromaticities"] == pytest.approx((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329))
    run(plate, *options, "--frames", "1002-1003", "--out", tmp_path / "out.mov")
    with av.open(str(tmp_path / "out.mov")) as container:
        stream = container.streams.video[0]
        assert (stream.metadata["timecode"], stream.sample_aspect_ratio, stream.average_rate) == ("01:02:03:05", 2, 24)
    write_exr(tmp_path / "cg.1001.exr", ExrPart(read_exr(tmp_path / "cg.exr")[0].channels, attributes={"framesPerSecond": Fraction(25)}))
    slower = (*options[:2], "--layer", tmp_path / "cg.%04d.exr", "--frames", "1001")
    refused("states 25 frames per second, but the clip says 24: nothing is retimed here", run, plate, *slower, "--out", tmp_path / "no.mov")
    retimed = "states 24 frames per second, but --rate says 25: nothing is retimed here"
    refused(retimed, run, plate, *options, "--rate", 25, "--out", tmp_path / "no.mov")


def test_missing_frames_stop_are_held_or_black(tmp_path: Path, options: list[str]) -> None:
    """Frame 3 of the plate, 4 of the layer and 5 of the depth are missing; frames that are not taken may be."""
    square, size = read_layer(tmp_path / "cg.exr"), (48, 64)
    for number in range(1, 7):
        if number != 3:
            write_exr(tmp_path / f"plate.{number}.exr", ExrPart(dict.fromkeys("RGB", np.full(size, 0.1 * number, np.float32))))
        if number != 4:
            write_layer(tmp_path / f"cg.{number}.exr", Layer(square.rgb * np.float32(number), square.alpha, square.depth_m))
        if number != 5:
            write_exr(tmp_path / f"z.{number}.exr", ExrPart({"Z": np.full(size, 5.0 if number < 6 else 1.0, np.float32)}))
    words = [tmp_path / "plate.%d.exr", "--rate", 24, *options[:2], "--layer", tmp_path / "cg.%d.exr", "--depth", tmp_path / "z.%d.exr"]
    for frames, sentence in (
        ("1-6", r"plate\.%d\.exr: 1 of the 6 frames are missing \(3\): render them, or say --missing hold"),
        ("4-6", r"cg\.%d\.exr: 1 of the 3 frames are missing \(4\)"),
        ("5", r"z\.%d\.exr: 1 of the 1 frames are missing \(5\)"),
    ):
        refused(sentence, run, *words, "--frames", frames, "--out", tmp_path / "no.%d.exr")
    refused("expected stop, hold or black, got 'loop'", run, *words, "--missing", "loop", "--out", tmp_path / "no.%d.exr")
    run(*words, "--frames", "1-2,6", "--out", tmp_path / "some.%d.exr")
    for missing, plates, cards in (("hold", [1, 2, 2, 4, 5, 6], [1, 2, 3, 3, 5]), ("black", [1, 2, 0, 4, 5, 6], [1, 2, 3, None, 5])):
        run(*words, "--missing", missing, "--out", tmp_path / f"{missing}.%d.exr")
        made = [read_image(tmp_path / f"{missing}.{number}.exr") for number in range(1, 7)]
        assert [each[2, 2, 0] for each in made] == pytest.approx([0.1 * each for each in plates], abs=1e-3)
        expected = [0.1 * plate if card is None else card for plate, card in zip(plates, cards, strict=False)]
        assert [each[24, 25, 0] for each in made[:5]] == pytest.approx(expected, abs=2e-3)
        assert made[5][24, 25, 0] == pytest.approx(0.6, abs=1e-3)  # behind what is 1 m away


def test_cryptomatte_of_each_frame_is_written(tmp_path: Path) -> None:
    height, width = beauty()["R"].shape
    write_lens(tmp_path / "lens.json", Lens(50.0, 8.0, 2.0, 36.0))
    for number in (1, 2):
        planes = beauty() | {"Z": np.full((height, width), 2.0, np.float32)}
        moved = {name: np.roll(plane, number, axis=1) for name, plane in crypto_channels().items()}
        write_exr(tmp_path / f"cg.{number}.exr", ExrPart(planes | moved, attributes=header()))
        write_exr(tmp_path / f"plate.{number}.exr", ExrPart(dict.fromkeys("RGB", np.zeros((height, width), np.float32))))
    options = ["--rate", 25, "--lens", tmp_path / "lens.json", "--layer", tmp_path / "cg.%d.exr", "--output-space", "ACEScg"]
    for more, name in (((), "out"), (("--virtual-only",), "layer")):
        run(tmp_path / "plate.%d.exr", *options, *more, "--out", tmp_path / f"{name}.%d.exr")
        for number in (1, 2):
            (found,) = cryptomattes(RenderChannels.read(tmp_path / f"{name}.{number}.exr")).values()
            np.testing.assert_array_equal(found.matte("near"), np.roll(coverages()["near"], number, axis=1))
