"""Sound that a container cannot hold is encoded anew: it is heard when it was heard, as loud as it was, in real files of real codecs."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mrbokeh.shots.executors import SerialExecutor
from mrbokeh.shots.render_shot import VideoTarget, held_pictures, render_shot
from mrbokeh.shots.shot import Shot
from mrbokeh.video.clip import read_frames
from mrbokeh.video.picture_source import open_source
from mrbokeh.video.writer import VideoWriter
from tests.support.shot_makers import Brighter

BEGINS_S = 0.5
PICTURES, RATE = 30, 25


def sounding(path: Path, codec: str, rate: int, begins_s: float = BEGINS_S, delay_s: float = 0.0) -> Path:
    """Two seconds of black and a tone of 440 Hz that begins at begins_s, left half as loud as full, right a quarter."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=RATE)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        audio = container.add_stream(codec, rate=rate, layout="stereo")
        for i in range(2 * RATE):
            frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), "rgb24")
            frame.pts, frame.time_base = i, Fraction(1, RATE)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        time_s = np.arange(int(rate * (2.0 - delay_s))) / rate + delay_s
        left = 0.5 * np.sin(2 * np.pi * 440 * time_s) * (time_s > begins_s)
        sound = av.AudioFrame.from_ndarray(np.stack([left, left / 2]).astype(np.float32), "fltp", "stereo")
        sound.sample_rate, sound.pts, sound.time_base = rate, round(delay_s * rate), Fraction(1, rate)
        container.mux(audio.encode(sound))
        container.mux(audio.encode(None))
    return path


def heard(path: Path) -> tuple[str, np.ndarray, float]:
    """(codec, (2, samples) at 48 kHz, seconds at which the first is heard), by PyAV's own decoder."""
    with av.open(str(path)) as container:
        stream = container.streams.audio[0]
        resampler = av.AudioResampler("fltp", "stereo", 48000)
        frames = [made for frame in [*container.decode(stream), None] for made in resampler.resample(frame)]
        return stream.codec_context.name, np.concatenate([frame.to_ndarray() for frame in frames], axis=1), frames[0].time


def black(out: Path, source: Path, start_s: float) -> str:
    """256x128, which DNxHR needs."""
    with VideoWriter(out, 256, 128, Fraction(RATE), audio_from=source, audio_start_s=start_s) as writer:
        for i in range(PICTURES):
            writer.write(np.zeros((128, 256, 3), np.float32), i / RATE)
    return writer.audio_note


@pytest.mark.parametrize("start_s", [0.0, 0.4])
@pytest.mark.parametrize(
    ("source", "rate", "suffix", "codec"),
    [
        ("aac.mp4", 44100, ".mxf", "pcm_s24le"), ("flac.mkv", 48000, ".mxf", "pcm_s16le"), ("flac.mkv", 44100, ".mov", "pcm_s16le"),
        ("libopus.mkv", 48000, ".mov", "pcm_s24le"), ("flac.mkv", 44100, ".mp4", "aac"),
    ],
)  # fmt: skip
def test_sound_arrives_when_and_as_loud_as_it_was(tmp_path: Path, source: str, rate: int, suffix: str, codec: str, start_s: float) -> None:
    """The tone begins at 0.5 s less the start, and is cut where the last of 30 pictures ends, at 1.2 s: 57600 samples.

    Matroska rounds times to 1 ms. A lossy codec overshoots where a tone begins: 5 % are allowed there, none in the middle.
    """
    name = source.split(".")[0]
    note = black(tmp_path / f"out{suffix}", sounding(tmp_path / source, name, rate), start_s)
    assert f"encoded anew, for {suffix} does not hold" in note and f"({codec}, 48 kHz)" in note
    found, samples, first_s = heard(tmp_path / f"out{suffix}")
    assert found == codec and first_s == pytest.approx(0.0, abs=1e-6)
    # AAC comes in packets of 1024 samples.
    assert samples.shape[1] == pytest.approx(57600, abs=1024 if codec == "aac" else 0)
    loud = np.flatnonzero(np.abs(samples[0]) > 0.02)
    assert loud[0] / 48000 == pytest.approx(BEGINS_S - start_s, abs=0.0015)
    # Of a sine the mean square is half of the square of its height: 0.354 of 0.5.
    middle = samples[:, loud[0] + 4800 : loud[0] + 24000]
    np.testing.assert_allclose(np.sqrt((middle**2).mean(axis=1)), [0.3536, 0.1768], rtol=0.01)
    assert np.abs(samples).max() < 0.525


def test_sixteen_bits_at_48_khz_come_through_bit_for_bit_and_what_is_missing_is_silence(tmp_path: Path) -> None:
    """Sound that begins late, at 0.3 s, or ends early: taken from 1.5 s on it lasts for 0.5 s of the 1.2."""
    black(tmp_path / "out.mxf", sounding(tmp_path / "pcm_s16le.mov", "pcm_s16le", 48000), 0.0)
    before, after = heard(tmp_path / "pcm_s16le.mov")[1], heard(tmp_path / "out.mxf")[1]
    np.testing.assert_array_equal(after, before[:, :57600])
    assert np.abs(after).max() > 0.49
    late = sounding(tmp_path / "late.mov", "pcm_s16le", 48000, delay_s=0.3)
    black(tmp_path / "begin.mxf", late, 0.0)
    black(tmp_path / "end.mxf", late, 1.5)
    begin, end = (heard(tmp_path / name)[1] for name in ("begin.mxf", "end.mxf"))
    assert np.flatnonzero(begin[0])[0] / 48000 == pytest.approx(BEGINS_S, abs=1e-3)
    assert end.shape[1] == 57600 and np.flatnonzero(end[0])[-1] / 48000 == pytest.approx(0.5, abs=2e-3)


@pytest.mark.slow
def test_a_real_clip_of_uneven_times_goes_into_mxf_with_its_sound(tmp_path: Path, shared_data: Path) -> None:
    """The iPhone's HEVC: 6 pictures of about 27.6 a second, held and left out for 30; its mono sound lasts as long as they do."""
    clip = shared_data / "video" / "iphone_xr_chart.mov"
    shot = Shot(open_source(clip), Brighter(0.0), VideoTarget(tmp_path / "out.mxf", None, clip, even_rate=Fraction(30)), range(3, 9), 3)
    note = render_shot(shot, SerialExecutor())
    assert "(pcm_s16le, 48 kHz)" in note
    frames, times_s = list(read_frames(tmp_path / "out.mxf")), np.array(shot.all_times_s)
    assert [frame.time_s for frame in frames] == pytest.approx([i / 30 for i in range(len(frames))], abs=1e-6)
    assert len(frames) == round(times_s[-1] * 30) + 1
    sources = [frame.rgb for frame in shot.source.frames(3, 9)]
    for i, frame in enumerate(frames):
        nearest = int(np.argmin(np.abs(times_s - i / 30)))
        made = 0.5 * sources[nearest]
        # Ten bits of halved chroma; another picture of the hand-held clip is several times as far.
        assert np.abs(frame.rgb - made).mean() < 0.004
    assert heard(tmp_path / "out.mxf")[1].shape[1] == 48000 * len(frames) // 30


def test_the_nearest_picture_is_held() -> None:
    """Halfway (0.02 s of 0 and 0.04; 0.1 would be of 0.04 and 0.16) the later one is shown."""
    for times_s, rate, expected in (
        ([0.0, 0.04, 0.08], 25, [0, 1, 2]), ([0.0, 0.04, 0.16, 0.2], 25, [0, 1, 1, 2, 2, 3]), ([0.0], 30, [0]),
        ([0.0, 0.02, 0.04, 0.06, 0.08], 25, [0, 2, 4]), ([0.0, 0.04], 50, [0, 1, 1]),
    ):  # fmt: skip
        assert held_pictures(times_s, Fraction(rate)) == expected
