"""Round trips of `mrbokeh serve` beside the blur itself: 1920x1080 through shared memory and through EXR files without compression.

    python -m tests.bench.bench_serve [REQUESTS]

Printed are medians of warm requests: the round trip as the caller sees it, the blur, and what comes on top. With EXR the caller's own
writing and reading of files is not counted.
"""

import signal
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from mrbokeh.hosts.client import ask, blurred
from mrbokeh.images.exr_io import ExrPart, write_exr
from tests.hosts.conftest import started

WIDTH_PX, HEIGHT_PX = 1920, 1080


def main(requests: int) -> None:
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX].astype(np.float32)
    rgb = np.dstack([0.5 + 0.4 * np.sin(columns / each) * np.cos(rows / each) for each in (9.0, 14.0, 23.0)]).astype(np.float32)
    depth_m = np.where(np.hypot(columns - 700, rows - 600) < 300, np.float32(1.5), 2.0 + rows / 200).astype(np.float32)
    request: dict[str, Any] = {"what": "render", "f_number": 2.0, "focal_length_mm": 50.0, "focus": 1.5}
    with tempfile.TemporaryDirectory() as folder:
        connection, sharp = Path(folder) / "server.json", Path(folder) / "sharp.exr"
        write_exr(sharp, ExrPart({**{name: rgb[..., i] for i, name in enumerate("RGB")}, "Z": depth_m}), compress=False)
        in_files = {**request, "picture": str(sharp), "out": str(Path(folder) / "out.exr"), "overwrite": True}
        with started(connection) as server:
            for name in ("memory", "EXR"):
                whole_s, blur_s = list[float](), list[float]()
                for _ in range(requests + 1):
                    begun_s = perf_counter()
                    if name == "memory":
                        answer = blurred(rgb, depth_m, connection=str(connection), **request)[1]
                    else:
                        answer = ask(in_files, str(connection))
                    whole_s.append(perf_counter() - begun_s)
                    blur_s.append(answer["blur_seconds"])
                beyond_s = [whole - blur for whole, blur in zip(whole_s[1:], blur_s[1:], strict=True)]
                told = f"{median(whole_s[1:]):.3f} s, the blur {median(blur_s[1:]):.3f} s, beyond it {median(beyond_s) * 1e3:.0f} ms"
                print(f"{name}: {told} (most {max(beyond_s) * 1e3:.0f} ms); the first {whole_s[0]:.2f} s")
            server.send_signal(signal.SIGINT)


if __name__ == "__main__":
    main(int((sys.argv[1:] or ["7"])[0]))
