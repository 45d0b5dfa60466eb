"""What it costs to send the stream: `python -m tests.bench.bench_streaming`.

A textured picture that pans by 3 px a frame with sensor noise, at 640x360 and 1280x720. Peers: the encoders of aiortc (H.264 with x264's
medium preset, one for each viewer; VP8) and, for the conversion to I420, FFmpeg's swscale (PyAV) and OpenCV. Then the whole way at
30 frames per second to one and to three viewers in this process, whose decoders take part in the CPU time that is printed.
"""

import asyncio
import time
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
import cv2
import numpy as np
from aiortc.codecs.h264 import H264Decoder, H264Encoder
from aiortc.codecs.vpx import Vp8Decoder, Vp8Encoder
from aiortc.jitterbuffer import JitterFrame

from tests.bench.machine import machine_line, memory_line
from tests.live.test_streaming_encoding import plain_i420, planes_of
from tests.scenes.streaming_viewers import Feed, Viewer, serving, streaming, watching
from viewfinder.streaming.encoders import STREAM_COLOR, StreamQuality, h264_encoder, i420_frame, vp8_encoder
from viewfinder.streaming.whep import Whep

SIZES = ((640, 360), (1280, 720))
FRAMES, FPS = 60, 30
NOISE_CODES = 2.0


def main() -> None:
    cv2.setNumThreads(1)
    for size in SIZES:
        frames = _panned(*size)
        print(f"{size[0]}x{size[1]} px")
        _conversions(frames[0])
        # aiortc's encoders send 3 Mb/s at most.
        quality = StreamQuality(bitrate_bps=min(StreamQuality().bits_per_s(*size), 3_000_000))
        ours = _ours("ours, H264", h264_encoder(*size, quality), H264Decoder(), frames)
        _ours("ours, VP8", vp8_encoder(*size, quality), Vp8Decoder(), frames)
        theirs = _theirs("aiortc, H264", H264Encoder(), H264Decoder(), frames, quality)
        _theirs("aiortc, VP8", Vp8Encoder(), Vp8Decoder(), frames, quality)
        print(f"  against aiortc's H264: {ours / theirs:.2f} of the CPU time for one viewer, {ours / theirs / 3:.2f} for three")
        for viewers in (1, 3):
            asyncio.run(_served(frames, viewers))
    print(memory_line())
    print(machine_line())


def _panned(width: int, height: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 256, (height, width + 3 * FRAMES, 3)).astype(np.float32), (0, 0), 3)
    wide = 128 + 6 * (wide - wide.mean())
    noisy = [wide[:, 3 * i : 3 * i + width] + NOISE_CODES * rng.standard_normal((height, width, 3)) for i in range(FRAMES)]
    return [np.clip(np.rint(frame), 0, 255).astype(np.uint8) for frame in noisy]


def _conversions(bgr: np.ndarray) -> None:
    height, width = bgr.shape[:2]

    def by_opencv() -> list[np.ndarray]:
        flat = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)
        chroma = flat[height:].reshape(2, height // 2, width // 2)
        return [flat[:height], chroma[0], chroma[1]]

    def by_swscale() -> Any:
        return av.VideoFrame.from_ndarray(bgr, "bgr24").reformat(format="yuv420p", dst_colorspace=5, dst_color_range=1)

    wanted = plain_i420(bgr, STREAM_COLOR)
    ways: dict[str, Callable[[], Any]] = {"ours": lambda: i420_frame(bgr), "swscale": by_swscale, "OpenCV": by_opencv}
    for name, convert in ways.items():
        made = convert()
        planes = made if isinstance(made, list) else planes_of(made)
        rms = [float(np.sqrt(np.mean((got - want) ** 2))) for got, want in zip(planes, wanted, strict=True)]
        spent_ms = _cpu_ms(lambda convert=convert: [convert() for _ in range(20)]) / 20
        print(f"  to I420, {name}: {spent_ms:.2f} ms, error {rms[0]:.2f} in luma, {max(rms[1:]):.2f} in chroma (RMS codes)")


def _cpu_ms(work: Callable[[], Any]) -> float:
    started_s = time.process_time()
    work()
    return 1000 * (time.process_time() - started_s)


def _ours(name: str, encoder: Any, decoder: Any, frames: list[np.ndarray]) -> float:
    packets: list[bytes] = []
    spent_ms = _cpu_ms(lambda: packets.extend(bytes(encoder.encode(i420_frame(bgr), 3000 * i)) for i, bgr in enumerate(frames)))
    return _line(name, spent_ms, packets, decoder, frames)


def _theirs(name: str, encoder: Any, decoder: Any, frames: list[np.ndarray], quality: StreamQuality) -> float:
    """aiortc converts by swscale if it has to; it gets our conversion, so that only the encoders differ."""
    encoder.target_bitrate = quality.bitrate_bps
    packets: list[bytes] = []

    def work() -> None:
        for i, bgr in enumerate(frames):
            frame = i420_frame(bgr)
            frame.pts, frame.time_base = i, Fraction(1, FPS)
            if isinstance(encoder, H264Encoder):
                packets.append(b"".join(b"\0\0\0\1" + unit for unit in encoder._encode_frame(frame, False)))
            else:
                payloads, _ = encoder.encode(frame)
                packets.append(b"".join(payload[_descriptor_bytes(payload) :] for payload in payloads))

    return _line(name, _cpu_ms(work), packets, decoder, frames)


def _descriptor_bytes(payload: bytes) -> int:
    from aiortc.codecs.vpx import VpxPayloadDescriptor

    return len(payload) - len(VpxPayloadDescriptor.parse(payload)[1])


def _line(name: str, spent_ms: float, packets: list[bytes], decoder: Any, frames: list[np.ndarray]) -> float:
    """Prints and gives CPU ms per frame."""
    shown = [picture for i, packet in enumerate(packets) for picture in decoder.decode(JitterFrame(packet, 3000 * i))]
    errors = [
        np.mean((planes_of(picture)[0].astype(float) - planes_of(i420_frame(bgr))[0]) ** 2)
        for picture, bgr in zip(shown, frames, strict=False)
    ]
    megabits = 8e-6 * sum(map(len, packets)) * FPS / len(frames)
    # The first pictures are the rate control's affair.
    psnr_db = 10 * np.log10(255**2 / np.mean(errors[10:]))
    print(f"  {name}: {spent_ms / len(frames):.1f} ms of CPU per frame, {megabits:.1f} Mb/s, {psnr_db:.1f} dB in luma")
    return spent_ms / len(frames)


async def _served(frames: list[np.ndarray], count: int) -> None:
    """Age when the status of a picture arrives (it is sent after its last packet), and CPU time of everything in this process."""
    with streaming() as stream, Feed(stream, lambda i: frames[i % FRAMES], FPS):
        async with serving(Whep(stream)) as url:
            entered = [watching(url) for _ in range(count)]
            viewers = [await each.__aenter__() for each in entered]
            ages_ms: list[float] = []
            await asyncio.gather(*(viewer.until(lambda viewer=viewer: len(viewer.statuses()) > 30, 60) for viewer in viewers))
            viewers[0].channel.on("message", lambda _: ages_ms.append(1000 * time.monotonic() - viewers[0].messages[-1]["captured_ms"]))
            encoded, started_s = stream.encoded["H264"], time.process_time()
            await asyncio.gather(*(_watch_for(viewer, 4.0) for viewer in viewers))
            spent_ms = 1000 * (time.process_time() - started_s) / (stream.encoded["H264"] - encoded)
            for each in entered:
                await each.__aexit__(None, None, None)
    p50_ms, p95_ms = np.percentile(ages_ms, [50, 95])
    rate = len(ages_ms) / 4.0
    print(
        f"  {count} viewer{'s' if count > 1 else ''} in this process: captured to arrived p50 {p50_ms:.1f} ms, p95 {p95_ms:.1f} ms, "
        f"{rate:.1f} frames/s, {spent_ms:.1f} ms of CPU per frame with {count} decoder{'s' if count > 1 else ''}"
    )


async def _watch_for(viewer: Viewer, time_s: float) -> None:
    end_s = time.monotonic() + time_s
    await viewer.until(lambda: time.monotonic() > end_s, 60)


if __name__ == "__main__":
    main()
