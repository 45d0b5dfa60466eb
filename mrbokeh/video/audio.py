"""The audio of one video into another: as it is stored where the container holds its codec, else decoded and encoded anew."""

from collections.abc import Iterator
from contextlib import ExitStack
from fractions import Fraction
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

import numpy as np

RATE = 48_000
"""Samples per second of what is encoded anew: that of film and television, and the only one of MXF."""
# What the containers hold and players expect in them. MXF wants its samples cut to its pictures, so it gets them from an encoder.
_STORABLE = {
    ".mp4": {"aac", "mp3", "ac3", "eac3", "alac", "opus"},
    ".mov": {"aac", "mp3", "ac3", "alac", "pcm_s16le", "pcm_s16be", "pcm_s24le", "pcm_s24be", "pcm_s32le", "pcm_f32le"},
    ".mxf": set(),
    ".nut": set(),
    ".mkv": {"aac", "mp3", "ac3", "eac3", "alac", "opus", "vorbis", "flac", "pcm_s16le", "pcm_s24le", "pcm_s32le", "pcm_f32le"},
}
# Encoder and its format of samples, each channel for itself; the second where the source has no more than 16 bit.
_PCM = (("pcm_s24le", "s32p"), ("pcm_s16le", "s16p"))
_AAC = (("aac", "fltp"), ("aac", "fltp"))
_ENCODED = {".mov": _PCM, ".mxf": _PCM, ".mkv": _PCM, ".mp4": _AAC}
_NUMBERS = {"s16p": np.int16, "s32p": np.int32, "fltp": np.float32}
_SHORT = ("u8", "u8p", "s16", "s16p")
_AAC_BITS_PER_S = 160_000
_JITTER = RATE // 50
"""Times of recorders waver; so many samples (20 ms) are neither filled with silence nor cut off."""


class CarriedAudio:
    """Carries the first audio stream of a video into an open PyAV container.

    start_s: the time of the source that becomes time 0. note: what became of the audio, for the user to read.
    """

    def __init__(self, source: Path, target: Any, suffix: str, start_s: float = 0.0) -> None:
        self._source, self._target, self._suffix, self._start_s = source, target, suffix, start_s
        self._feed: _Feed | None = None
        self.note = "no audio"

    def __enter__(self) -> "CarriedAudio":
        import av

        with ExitStack() as stack:
            container = stack.enter_context(av.open(str(self._source)))
            if container.streams.audio:
                self._feed = self._feed_of(container, container.streams.audio[0])
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stack.close()

    def _feed_of(self, container: Any, audio: Any) -> "_Feed":
        name = audio.codec_context.name
        if name in _STORABLE[self._suffix]:
            self.note = f"audio copied ({name})"
            return _Copied(container, audio, self._target, self._start_s)
        codec, samples = _ENCODED[self._suffix][audio.format.name in _SHORT]
        self.note = f"audio encoded anew, for {self._suffix} does not hold {name} as it is ({codec}, {RATE // 1000} kHz)"
        return _Encoded(_heard(container, audio, samples, self._start_s), audio, self._target, (codec, samples))

    def copy_until(self, time_s: float) -> None:
        """Copy the sound before `time_s` of the new video, so that picture and sound lie side by side in the file."""
        if self._feed is not None:
            self._feed.copy_until(time_s)

    def finish(self, time_s: float) -> None:
        """Copy the rest, up to the end of the new video."""
        if self._feed is not None:
            self._feed.copy_until(time_s)
            self._feed.flush(time_s)


@runtime_checkable
class _Feed(Protocol):
    def copy_until(self, time_s: float) -> None: ...

    def flush(self, time_s: float) -> None: ...


class _Copied:
    """Feed that copies packet by packet."""

    def __init__(self, container: Any, audio: Any, target: Any, start_s: float) -> None:
        self._packets, self._target, self._start_s = container.demux(audio), target, start_s
        self._stream = target.add_stream_from_template(audio)
        self._waiting: Any = None

    def copy_until(self, time_s: float) -> None:
        while True:
            if self._waiting is None:
                self._waiting = next(self._packets, None)
            packet = self._waiting
            if packet is None:
                return
            if packet.pts is not None:
                heard_s = float(packet.pts * packet.time_base) - self._start_s
                if heard_s >= time_s:
                    return
                if heard_s >= 0:
                    self._mux(packet)
            self._waiting = None

    def flush(self, time_s: float) -> None:
        """Do nothing: no packet waits."""

    def _mux(self, packet: Any) -> None:
        shift = round(self._start_s / packet.time_base)
        packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
        packet.stream = self._stream
        self._target.mux(packet)


class _Encoded:
    """Feed that encodes samples: the sound begins and ends with the pictures, and silence fills gaps of the source."""

    def __init__(self, heard: "Iterator[tuple[int, np.ndarray]]", audio: Any, target: Any, encoder: tuple[str, str]) -> None:
        codec, self._format = encoder
        self._heard, self._target, self._layout = heard, target, _layout(audio)
        rates = {"bit_rate": _AAC_BITS_PER_S * (audio.channels + 1) // 2} if codec == "aac" else {}
        self._stream = target.add_stream(codec, rate=RATE, layout=self._layout, **rates)
        self._rest, self._written = np.zeros((audio.channels, 0), _NUMBERS[self._format]), 0

    def copy_until(self, time_s: float) -> None:
        stop = round(time_s * RATE)
        while self._written < stop:
            if not self._rest.shape[1] and not self._take():
                return
            now, self._rest = np.split(self._rest, [stop - self._written], axis=1)
            self._write(now)

    def flush(self, time_s: float) -> None:
        missing = round(time_s * RATE) - self._written
        if missing > 0:
            self._write(np.zeros((self._rest.shape[0], missing), self._rest.dtype))
        self._target.mux(self._stream.encode(None))

    def _take(self) -> bool:
        """Take some more samples; False at the end."""
        for begin, samples in self._heard:
            gap = begin - self._written
            gap = 0 if self._written and abs(gap) <= _JITTER else gap
            silence = np.zeros((samples.shape[0], max(gap, 0)), samples.dtype)
            self._rest = np.concatenate([silence, samples[:, max(-gap, 0) :]], axis=1)
            if self._rest.shape[1]:
                return True
        return False

    def _write(self, samples: np.ndarray) -> None:
        import av

        frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(samples), self._format, self._layout)
        frame.sample_rate, frame.pts, frame.time_base = RATE, self._written, Fraction(1, RATE)
        self._target.mux(self._stream.encode(frame))
        self._written += samples.shape[1]


def _heard(container: Any, audio: Any, samples: str, start_s: float) -> "Iterator[tuple[int, np.ndarray]]":
    """Yield (place of the first one in the new video, (channels, count)) of samples at RATE."""
    import av

    resampler: Any = av.AudioResampler(format=samples, layout=_layout(audio), rate=RATE)
    for frame in chain(container.decode(audio), [None]):
        for made in resampler.resample(frame):
            yield round((made.pts * made.time_base - Fraction(start_s)) * RATE), made.to_ndarray()


def _layout(audio: Any) -> str:
    """Return the layout of channels; some cameras count channels without saying which they are."""
    return {1: "mono", 2: "stereo"}.get(audio.channels, str(audio.layout.name))
