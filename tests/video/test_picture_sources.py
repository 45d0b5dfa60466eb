"""Sources of frames: any stretch of them is what reading all of them gives, picture and time, to the bit."""

import pickle
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.system.errors import InputError
from mrbokeh.video.clip import read_frames
from mrbokeh.video.image_sequence import NumberedFiles, is_pattern, numbered, pattern_of_folder
from mrbokeh.video.picture_source import FrameIndex, PictureSource, VideoSource, open_source, parse_rate
from mrbokeh.video.writer import VideoWriter
from tests.support.refusals import refused
from tests.support.video_files import encoded

CLIPS = ("iphone_xr_chart.mov", "ducks_720p.mp4", "nikon_d90_chart.avi")


def counting_clip(path: Path, encoding: str, count: int = 24) -> Path:
    """Frame i is grey i / 40 with a few coded differences; times are uneven, as of a phone."""
    ramp = np.linspace(0, 0.2, 64, dtype=np.float32)[None, :, None]
    with VideoWriter(path, 64, 48, Fraction(25), Fraction(1, 1000), encoding=encoding) as writer:
        for i in range(count):
            picture = np.broadcast_to(i / 40 + np.roll(ramp, 5 * i, axis=1), (48, 64, 3)).astype(np.float32)
            writer.write(picture, (40 * i + 9 * (i % 3)) / 1000)
    return path


def luma_hash(frame: av.VideoFrame) -> int:
    """Of the luma that is shown; what pads its rows is left to chance."""
    plane = frame.planes[0]
    return hash(np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width].tobytes())


def checksums(path: Path) -> list[tuple[int, int]]:
    """(time, sum of the decoded bytes) of every frame, decoded from the beginning on by PyAV itself."""
    with av.open(str(path)) as container:
        return [(frame.pts, luma_hash(frame)) for frame in container.decode(video=0)]


@pytest.mark.slow
@pytest.mark.parametrize("step", [29, 1])
@pytest.mark.parametrize("name", CLIPS)
def test_real_clips_are_entered_anywhere_at_the_exact_frame(shared_data: Path, name: str, step: int) -> None:
    """Every frame (or every 29th) is entered at, B-frames and uneven times included; decoded bytes are compared."""
    path = shared_data / "video" / name
    source, expected = VideoSource.open(path), checksums(path)
    assert source.info.frame_count == len(source.times_s) == len(expected)
    assert [tick for tick, _ in expected] == source.index.shown.tolist()
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        for start in range(0, len(expected), step):
            if start:
                container.seek(0, stream=stream)
            entered = []
            for number, frame in source._numbered_from(start, container, stream):
                if number >= start:
                    entered.append((frame.pts, luma_hash(frame)))
                if number >= start + 1:
                    break
            assert entered == expected[start : start + 2], f"entered at frame {start}"


@pytest.mark.slow
@pytest.mark.parametrize("name", CLIPS)
def test_a_stretch_of_a_real_clip_is_what_reading_it_all_gives(shared_data: Path, name: str) -> None:
    path = shared_data / "video" / name
    source = pickle.loads(pickle.dumps(VideoSource.open(path)))
    for start, stop in ((0, 1), (17, 19)):
        for there, here in zip(read_frames(path, start, stop), source.frames(start, stop), strict=True):
            assert here.time_s == there.time_s == source.times_s[start]
            np.testing.assert_array_equal(here.rgb, there.rgb)
            start += 1


@pytest.mark.parametrize(
    ("encoding", "suffix"),
    [("h264", ".mp4"), ("h264", ".mkv"), ("h265-10bit", ".mov"), ("h265-10bit", ".mkv"), ("ffv1", ".mkv"), ("prores422", ".mov")],
)
def test_every_encoding_can_be_entered_anywhere(tmp_path: Path, encoding: str, suffix: str) -> None:
    path = counting_clip(tmp_path / f"clip{suffix}", encoding)
    source, whole = open_source(path), list(read_frames(path))
    assert isinstance(source, PictureSource)
    for start in range(24):
        stop = min(start + 2, 24)
        for there, here in zip(whole[start:stop], source.frames(start, stop, threads=1), strict=True):
            assert here.time_s == there.time_s
            np.testing.assert_array_equal(here.rgb, there.rgb)


def test_groups_of_pictures_that_refer_to_others_are_entered_exactly(tmp_path: Path) -> None:
    """H.265 with open groups of 6 pictures, as phones and broadcasters write: pictures before a keyframe need the group before it."""
    rng = np.random.default_rng(2)
    planes = [np.clip(rng.normal(4 * i + 40, 9, (96, 64)), 0, 255).astype(np.uint8) for i in range(40)]
    options = {"x265-params": "open-gop=1:keyint=6:min-keyint=6:scenecut=0:bframes=3:log-level=none"}
    frames = [av.VideoFrame.from_ndarray(each, "yuv420p") for each in planes]
    path = encoded(tmp_path / "open.mp4", "libx265", "yuv420p", *frames, options=options)
    source, whole = VideoSource.open(path), list(read_frames(path))
    assert len(source.index.keys_before(39)) > 4
    for start in range(40):
        np.testing.assert_array_equal(next(source.frames(start, start + 1)).rgb, whole[start].rgb)


def test_a_stream_without_times_is_counted_and_a_cut_off_video_is_told(tmp_path: Path) -> None:
    """Raw H.264 has no container that could tell times."""
    clip, path = counting_clip(tmp_path / "clip.mp4", "h264"), tmp_path / "clip.h264"
    with av.open(str(clip)) as source, av.open(str(path), "w", format="h264") as raw:
        stream = raw.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.size:
                packet.stream = stream
                raw.mux(packet)
    assert len(FrameIndex.of(path).shown) == 24
    there = list(read_frames(clip))
    for i in (0, 7, 23):
        np.testing.assert_allclose(next(VideoSource.open(path).frames(i, i + 1)).rgb, there[i].rgb, atol=1e-6)
    cut = counting_clip(tmp_path / "clip.mkv", "ffv1")
    source = VideoSource.open(cut)
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    refused("cannot be decoded", list, source.frames(0, 24))


@pytest.mark.parametrize(("suffix", "error"), [(".exr", 2**-11), (".png", 2.3 / 65535), (".tif", 2.3 / 65535)])
def test_numbered_pictures_are_a_source(tmp_path: Path, suffix: str, error: float) -> None:
    """Half has 11 bits; a step of 16-bit sRGB is 1/65535 of code, and the curve's slope at white is 2.3."""
    rng = np.random.default_rng(5)
    pictures = rng.random((4, 24, 32, 3), np.float32)
    for i, rgb in enumerate(pictures):
        write_image(tmp_path / f"frame.{1001 + i}{suffix}", rgb)
    source = pickle.loads(pickle.dumps(open_source(tmp_path / f"frame.%04d{suffix}", "24000/1001")))
    assert isinstance(source, PictureSource)
    assert (source.first_number, source.info.frame_count, source.info.frame_rate) == (1001, 4, Fraction(24000, 1001))
    frames = list(source.frames(1, 4))
    np.testing.assert_allclose([frame.rgb for frame in frames], pictures[1:], atol=error)
    assert [frame.time_s for frame in frames] == pytest.approx([i * 1001 / 24000 for i in (1, 2, 3)], abs=1e-12)
    assert source.times_s[3] == frames[2].time_s
    np.testing.assert_array_equal(frames[0].rgb, read_image(tmp_path / f"frame.1002{suffix}"))


def test_patterns_are_understood(tmp_path: Path) -> None:
    for number in (7, 8, 9, 10):
        (tmp_path / f"a_{number:03d}.exr").touch()
        (tmp_path / f"b{number}.exr").touch()
    (tmp_path / "a_x.exr").touch()
    assert NumberedFiles.found(tmp_path / "a_%03d.exr") == NumberedFiles(tmp_path / "a_%03d.exr", 7, 4)
    assert NumberedFiles.found(tmp_path / "b%d.exr").file(3).name == "b10.exr"
    assert (numbered(Path("f.%04d.png"), 12), is_pattern("f.%04d.png"), is_pattern("100%.png")) == (Path("f.0012.png"), True, False)
    (tmp_path / "a_008.exr").unlink()
    found = NumberedFiles.found(tmp_path / "a_%03d.exr")
    assert found.missing == {8} and [each.name for each in found.files] == ["a_007.exr", "a_009.exr", "a_010.exr"]
    refused("there is none", NumberedFiles.found, tmp_path / "c.%04d.exr")
    with pytest.raises(InputError, match=r"frame 4 needs .*b11\.exr, but the sequence ends with .*b10\.exr"):
        NumberedFiles.found(tmp_path / "b%d.exr").file(4)


def test_number_signs_stand_for_digits(tmp_path: Path) -> None:
    """frames.####.exr is frames.%04d.exr: four digits at least."""
    for number in (9998, 9999, 10000):
        write_image(tmp_path / f"frames.{number}.exr", np.full((8, 12, 3), (number - 9990) / 16, np.float32))
    (tmp_path / "frames.12.exr").touch()
    pattern = tmp_path / "frames.####.exr"
    found, same = NumberedFiles.found(pattern), NumberedFiles.found(tmp_path / "frames.%04d.exr")
    assert (found.first, found.count) == (9998, 3) and found.files == same.files
    names = [numbered(Path(name), 12).name for name in ("f.####.exr", "f.#.exr", "f_##_left.png")]
    assert names == ["f.0012.exr", "f.12.exr", "f_12_left.png"]
    assert is_pattern("f.####.exr") and not is_pattern("folder##/f.exr")
    source = open_source(pattern, "24")
    assert (source.first_number, source.info.frame_count) == (9998, 3)
    assert [float(frame.rgb[0, 0, 0]) for frame in source.frames(0, 3)] == [8 / 16, 9 / 16, 10 / 16]
    (tmp_path / "frames.9999.exr").unlink()
    source = open_source(pattern, "24")
    assert source.info.frame_count == 3 and next(source.frames(2, 3)).rgb[0, 0, 0] == 10 / 16
    refused(r"1 of the 1 frames are missing \(9999\): render them, or say --missing hold", list, source.frames(0, 3))
    for missing, light in (("hold", 8 / 16), ("black", 0.0)):
        frames = list(open_source(pattern, "24", missing=missing).frames(0, 3))
        assert [float(frame.rgb[0, 0, 0]) for frame in frames] == [8 / 16, light, 10 / 16]
        assert frames[1].time_s == pytest.approx(1 / 24)


def test_a_folder_stands_for_the_only_sequence_in_it(tmp_path: Path) -> None:
    """Hidden files, folders and files without a number beside it do not matter; where there is none, or two, the user says which."""
    refused(r"holds no numbered pictures: name one, such as .*frames\.%04d\.exr", open_source, tmp_path, "25")
    for number in (8, 9, 10):
        write_image(tmp_path / f"shot2_v{number:03d}.exr", np.full((8, 12, 3), number / 16, np.float32))
    for name in ("notes.txt", ".shot2_v011.exr.part"):
        (tmp_path / name).touch()
    (tmp_path / "take1").mkdir()
    assert pattern_of_folder(tmp_path) == tmp_path / "shot2_v%03d.exr"
    source = open_source(tmp_path, "25")
    assert (source.first_number, source.info.frame_count) == (8, 3)
    assert [float(frame.rgb[0, 0, 0]) for frame in source.frames(0, 3)] == [8 / 16, 9 / 16, 10 / 16]
    (tmp_path / "depth.008.exr").touch()
    refused(r"holds 2 sequences \(depth\.%03d\.exr, shot2_v%03d\.exr\): name one", open_source, tmp_path, "25")
    # 9.png and 10.png are one sequence: the shortest number says how many digits there are at least.
    (tmp_path / "other").mkdir()
    for number in (9, 10):
        (tmp_path / "other" / f"{number}.png").touch()
    assert [each.name for each in NumberedFiles.found(pattern_of_folder(tmp_path / "other")).files] == ["9.png", "10.png"]


def test_rates_are_understood(tmp_path: Path) -> None:
    film = Fraction(24000, 1001)
    assert [parse_rate(text) for text in ("25", "23.976", "24000/1001", "12.5")] == [25, film, film, Fraction(25, 2)]
    for text in ("0", "-3", "fast", "1/0"):
        refused("frames per second", parse_rate, text)
    write_image(tmp_path / "f.0001.exr", np.zeros((4, 6, 3), np.float32))
    refused("give --rate", open_source, tmp_path / "f.%04d.exr")
    refused("leave it out", open_source, tmp_path / "clip.mp4", "25")
