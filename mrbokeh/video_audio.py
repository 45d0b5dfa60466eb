"""The audio of one video into another, as it is stored, without decoding."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

# What the containers hold and players expect in them.
_STORABLE = {
    ".mp4": {"aac", "mp3", "ac3", "eac3", "alac", "opus"},
    ".mov": {"aac", "mp3", "ac3", "alac", "pcm_s16le", "pcm_s16be", "pcm_s24le", "pcm_s24be", "pcm_s32le", "pcm_f32le"},
    ".mxf": set(),
    ".nut": set(),
    ".mkv": {"aac", "mp3", "ac3", "eac3", "alac", "opus", "vorbis", "flac", "pcm_s16le", "pcm_s24le", "pcm_s32le", "pcm_f32le"},
}


class AudioCopy:
    """Copies the first audio stream of a video packet by packet into an open PyAV container.

    start_s: the time of the source that becomes time 0. note: what became of the audio, for the user to read.
    """

    def __init__(self, source: Path, target: Any, suffix: str, start_s: float = 0.0) -> None:
        self._source, self._target, self._suffix, self._start_s = source, target, suffix, start_s
        self._packets: Iterator[Any] = iter(())
        self._waiting: Any = None
        self.note = "no audio"

    def __enter__(self) -> "AudioCopy":
        import av

        with ExitStack() as stack:
            container = stack.enter_context(av.open(str(self._source)))
            if container.streams.audio:
                audio = container.streams.audio[0]
                name = audio.codec_context.name
                if name in _STORABLE[self._suffix]:
                    self._stream = self._target.add_stream_from_template(audio)
                    self._packets, self.note = container.demux(audio), f"audio copied ({name})"
                else:
                    others = " or ".join(suffix for suffix in _STORABLE if name in _STORABLE[suffix])
                    self.note = f"audio dropped: {name} does not fit into {self._suffix}" + (
                        f"; write {others} to keep it" if others else ""
                    )
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stack.close()

    def copy_until(self, time_s: float) -> None:
        """Copy what sounds before `time_s` of the new video, so that picture and sound lie side by side in the file."""
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

    def _mux(self, packet: Any) -> None:
        shift = round(self._start_s / packet.time_base)
        packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
        packet.stream = self._stream
        self._target.mux(packet)
