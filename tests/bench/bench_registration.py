"""How well and how fast slices are registered: `python -m tests.bench.bench_registration`.

A traced stack of 10 slices of 640x428 px whose camera moved by up to 1.2 px and 0.03 degrees between slices, with 1 % shot
noise: how far the worst corner of the worst slice lies off. Peers: chains of neighbours by OpenCV's findTransformECC on
luminance (affine, as focus-stack and others use it), by its findTransformECCMultiScale, and by SIFT with RANSAC; and the
breathing of the lens alone. Then CPU seconds for 10 photographs of 3 megapixels where they lie beside the checkout.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from capture.merging.registration.alignment import register_stack
from capture.merging.registration.plane_transforms import (
    Transform,
    about_centre,
    as_similarity,
    chained,
    from_opencv_centres,
    inverse,
    to_opencv_centres,
    warp,
)
from mrbokeh.images.image_io import read_image
from tests.bench.machine import machine_line, memory_line
from tests.scenes.jittered_stack import JITTER_PX, JITTER_RAD, JitteredStack, jittered_stack

SIZE_PX, SLICES, SAMPLES = (640, 428), 10, 48
NOISE = 0.01
PHOTOGRAPHS = Path(__file__).resolve().parents[3] / "shared" / "data" / "stacks" / "button_macro"
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-6)

Pair = Callable[[np.ndarray, np.ndarray, Transform], Transform]


def main() -> None:
    stack = _noisy(jittered_stack(JITTER_PX, JITTER_RAD, SIZE_PX, SLICES, SAMPLES))
    distances = np.array(stack.image_distances)
    prior = [about_centre(distances[0] / each, *SIZE_PX) for each in distances]
    print(f"{SLICES} slices of {SIZE_PX[0]}x{SIZE_PX[1]} px; worst corner off in px, CPU seconds")
    print(f"  breathing of the lens alone: {max(stack.errors_px(0, tuple(prior))):.3f} px")
    theirs = {name: _line(name, stack, partial(_chain, stack.slices, pair, prior)) for name, pair in PEERS.items()}
    ours = _line("register_stack, lens known", stack, partial(_ours, stack, stack.image_distances))
    _line("register_stack, lens unknown", stack, partial(_ours, stack, None))
    ecc = theirs["OpenCV ECC chain"]
    print(f"  against OpenCV's ECC chain: {ours[0] / ecc[0]:.2f} of the error, {ours[1] / ecc[1]:.2f} of the CPU time")
    if PHOTOGRAPHS.is_dir():
        _photographs()
    print(memory_line())
    print(machine_line())


def _noisy(stack: JitteredStack) -> JitteredStack:
    """Shot noise that grows as photons do."""
    rng = np.random.default_rng(0)
    noises = [NOISE * np.sqrt(np.maximum(rgb, 0.0)) * rng.standard_normal(rgb.shape) for rgb in stack.slices]
    noisy = tuple((rgb + noise).astype(np.float32) for rgb, noise in zip(stack.slices, noises, strict=True))
    return JitteredStack(noisy, stack.first_from_slice, stack.image_distances)


def _ours(stack: JitteredStack, image_distances: tuple[float, ...] | None) -> tuple[Transform, ...]:
    return register_stack(stack.slices.__getitem__, len(stack.slices), image_distances).reference_from_slice


def _line(what: str, stack: JitteredStack, register: Callable[[], tuple[Transform, ...]]) -> tuple[float, float]:
    """(worst error in px, CPU seconds)."""
    started_s = time.process_time()
    found = register()
    took_s = time.process_time() - started_s
    reference = min(range(len(found)), key=lambda i: float(np.abs(found[i] - np.eye(2, 3)).max()))
    error_px = max(stack.errors_px(reference, found))
    print(f"  {what}: {error_px:.3f} px, {took_s:.2f} s")
    return error_px, took_s


def _chain(pictures: tuple[np.ndarray, ...], pair: Pair, prior: list[Transform]) -> tuple[Transform, ...]:
    chain = [np.eye(2, 3)]
    for i in range(1, len(pictures)):
        start = chained(inverse(prior[i - 1]), prior[i])
        chain.append(chained(chain[-1], pair(pictures[i - 1], pictures[i], start)))
    return tuple(chain)


def _ecc(target: np.ndarray, source: np.ndarray, start: Transform) -> Transform:
    guess = to_opencv_centres(inverse(start)).astype(np.float32)
    _, found = cv2.findTransformECC(_luminance(target), _luminance(source), guess, cv2.MOTION_AFFINE, _STOP)
    return _similarity_from_opencv(found, target)


def _ecc_multi_scale(target: np.ndarray, source: np.ndarray, start: Transform) -> Transform:
    guess = to_opencv_centres(inverse(start)).astype(np.float32)
    _, found = cv2.findTransformECCMultiScale(_luminance(target), _luminance(source), guess)
    return _similarity_from_opencv(found, target)


def _sift(target: np.ndarray, source: np.ndarray, _: Transform) -> Transform:
    sift = cv2.SIFT.create(3000)
    (to_points, to_features), (from_points, from_features) = (sift.detectAndCompute(_display(each), None) for each in (target, source))
    found = cv2.BFMatcher().knnMatch(from_features, to_features, k=2)
    kept = [near for near, next_best in found if near.distance < 0.8 * next_best.distance]
    source_px = np.array([from_points[each.queryIdx].pt for each in kept]) + 0.5
    target_px = np.array([to_points[each.trainIdx].pt for each in kept]) + 0.5
    similarity, _ = cv2.estimateAffinePartial2D(source_px, target_px, method=cv2.RANSAC, ransacReprojThreshold=1.0)
    return similarity


PEERS: dict[str, Pair] = {"OpenCV ECC chain": _ecc, "OpenCV ECC chain, multi-scale": _ecc_multi_scale, "SIFT and RANSAC chain": _sift}


def _luminance(rgb: np.ndarray) -> np.ndarray:
    return cv2.transform(rgb, np.array([[0.2126, 0.7152, 0.0722]], np.float32))


def _display(rgb: np.ndarray) -> np.ndarray:
    return np.clip(255.0 * np.sqrt(np.maximum(_luminance(rgb), 0.0)), 0, 255).astype(np.uint8)


def _similarity_from_opencv(source_from_target: np.ndarray, picture: np.ndarray) -> Transform:
    affine = inverse(from_opencv_centres(np.asarray(source_from_target, np.float64)))
    return as_similarity(affine, picture.shape[1], picture.shape[0])


def _photographs() -> None:
    pictures = [read_image(path) for path in sorted(PHOTOGRAPHS.glob("[0-9]*.jpg"))]
    started_s = time.process_time()
    registration = register_stack(pictures.__getitem__, len(pictures))
    registered_s = time.process_time()
    for picture, transform in zip(pictures, registration.reference_from_slice, strict=True):
        warp(picture, transform)
    warped_s = time.process_time()
    _chain(tuple(pictures), _ecc, list(registration.reference_from_slice))
    chained_s = time.process_time()
    height, width = pictures[0].shape[:2]
    print(f"{len(pictures)} photographs of {width}x{height} px, CPU seconds: register {registered_s - started_s:.2f}, ", end="")
    print(f"warp {warped_s - registered_s:.2f}; OpenCV's ECC chain, started from what was found, {chained_s - warped_s:.2f}")


if __name__ == "__main__":
    main()
