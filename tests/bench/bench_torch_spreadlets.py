"""How long spreadlets take by torch: `python -m tests.bench.bench_torch_spreadlets [--device cuda] [--size 1024]`.

Two layers with defocus and motion through a COMBINED bank, all on the device, to one picture; the compiled renderer does the same
in the same run, and both pictures are compared. Points of kernels are made before. Then what single precision would cost.
"""

import argparse
import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.psf_models.build import Combined, build_bank
from mrbokeh.renderers.bank.tables import Place
from mrbokeh.renderers.kernels.laplacian_integration import laplacian
from mrbokeh.renderers.spreadlets.laplacian_spreadlets import LaplacianSpreadlets
from mrbokeh.renderers.spreadlets.torch_spreadlets import DeviceLayer, TorchSpreadlets
from mrbokeh.renderers.spreadlets.torch_spreadlets._sums import integrate
from mrbokeh.system.torch_device import has_triton
from tests.bench.device_timing import milliseconds
from tests.bench.machine import machine_line, memory_line

LARGEST_PX, CELLS = 48.0, 60
BALL_PX, WAYS = 64, 12
LAMP = 1e3

Sheet = tuple[np.ndarray, np.ndarray, np.ndarray]


def combined() -> PsfBank:
    with TemporaryDirectory() as folder:
        return build_bank(Combined(LARGEST_PX, LARGEST_PX, cells=CELLS), Path(folder) / "bank")


def behind(size: int) -> Sheet:
    """An opaque texture with lamps, 12 to 40 px out of focus; the camera pans by 8 to 32 px."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(size=(size, size, 3)).astype(np.float32), (0, 0), 1.5)
    texture = (texture - texture.min()) / np.ptp(texture)
    texture[rng.uniform(size=(size, size)) < 1 / 5000] = LAMP
    share = np.linspace(0.0, 1.0, size, dtype=np.float32)[:, None] * np.ones((1, size), np.float32)
    motion_px = (8.0 + 24.0 * share)[..., None] * np.float32([0.995, -0.1])
    return np.dstack([texture, np.ones((size, size), np.float32)]), 40.0 - 28.0 * share, motion_px.astype(np.float32)


def in_front(size: int) -> Sheet:
    """Balls that cover two fifths of the picture, 16 to 30 px out of focus before it; each flies its own way, 24 to 40 px."""
    rows, columns = np.indices((size, size), dtype=np.float32)
    waves = np.sin(rows * np.pi / BALL_PX) * np.sin(columns * np.pi / BALL_PX)
    covered = cv2.GaussianBlur((np.abs(waves) > 0.45).astype(np.float32), (0, 0), 0.7)
    ball = (rows // BALL_PX * 5 + columns // BALL_PX * 3).astype(np.int64)
    way, length_px = 2.0 * np.pi * (ball % WAYS) / WAYS + 0.1, 24.0 + 16.0 * (ball % 7) / 6.0
    motion_px = np.stack([np.cos(way) * length_px, np.sin(way) * length_px], axis=2)
    colour = np.stack([0.3 + 0.2 * np.sin(columns / 9.0), 0.4 + 0.2 * np.sin(rows / 7.0), np.full_like(rows, 0.2)], axis=2)
    coc_px = -23.0 - 7.0 * np.sin(rows * 6.0 / size)
    return np.dstack([colour * covered[..., None], covered]).astype(np.float32), coc_px.astype(np.float32), motion_px.astype(np.float32)


def by_the_cpu(renderer: LaplacianSpreadlets, sheets: list[Sheet]) -> np.ndarray:
    front, back = (renderer.sum_bank_kernels(values, coc_px, Place(motion_px=motion)) for values, coc_px, motion in sheets)
    return front + (1.0 - np.clip(front[..., 3:], 0.0, 1.0)) * back


def picture_rows(device_name: str, size: int) -> None:
    bank, sheets = combined(), [in_front(size), behind(size)]
    cpu, on_device = LaplacianSpreadlets(bank), TorchSpreadlets(bank, device_name)
    device = on_device.device
    layers = [DeviceLayer(*(torch.from_numpy(np.ascontiguousarray(plane)).to(device) for plane in sheet)) for sheet in sheets]
    known = by_the_cpu(cpu, sheets)
    started_s = time.perf_counter()
    found = on_device.picture(layers).cpu().numpy()
    first_s = time.perf_counter() - started_s
    print(f"{len(bank.kernels)} kernels of up to {2 * bank.radius_px + 1} px; first picture {first_s:.1f} s, with points to be found")
    with torch.inference_mode():
        took_ms = milliseconds(lambda: on_device.picture(layers), device)
        each_ms = [milliseconds(lambda layer=layer: on_device.sum_kernels(layer), device) for layer in layers]
    cpu_ms = milliseconds(lambda: by_the_cpu(cpu, sheets), torch.device("cpu"))
    print(f"two layers of {size} x {size} to a picture: {took_ms:.1f} ms (in front {each_ms[0]:.1f}, behind {each_ms[1]:.1f})")
    print(f"  the compiled renderer on all cores ({os.cpu_count()}): {cpu_ms:.0f} ms, {cpu_ms / took_ms:.2f} times as long")
    print(f"  largest difference {np.abs(found - known).max():.1e} of {known.max():.0f}, {psnr(found, known):.0f} dB to a peak of 1")
    if device.type == "cuda":
        print(f"  memory of the device: {torch.cuda.max_memory_allocated(device) / 2**20:.0f} MB")


def precision_rows(device: torch.device, size: int) -> None:
    """The Laplacian of the two layers' texture and a disc of 40 px that a lamp makes, integrated."""
    image = np.zeros((size + 256, size + 256, 1))
    image[128:-128, 128:-128, 0] = cv2.GaussianBlur(behind(size)[0][..., 0].clip(0.0, 1.0), (0, 0), 8)
    image[300:340, 300:340] += LAMP / 1600.0
    source = torch.from_numpy(laplacian(image)[1:-1, 1:-1]).to(device).permute(2, 0, 1).contiguous()
    for name, rounded in (
        ("double", source),
        ("single, of exact sums", source.float()),
        ("double, of single sums", source.float().double()),
    ):
        took_ms = milliseconds(lambda part=rounded: integrate(part), device)
        error = float((integrate(rounded)[0].double().cpu() - torch.from_numpy(image[..., 0])).abs().max())
        print(f"integration in {name:<22} {took_ms:8.2f} ms a channel, largest error {error:.1e} of {image.max():.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--size", type=int, default=1024, help="pixels along each side")
    wanted = parser.parse_args()
    device = torch.device(wanted.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "the processor"
    by = "a Triton kernel" if device.type == "cuda" and has_triton() else "torch, in chunks"
    print(f"device {wanted.device}: {name}; torch {torch.__version__}, splatting by {by}; load before the run {os.getloadavg()[0]:.1f}")
    picture_rows(wanted.device, wanted.size)
    precision_rows(device, wanted.size)
    print(machine_line())
    print(memory_line())


if __name__ == "__main__":
    main()
