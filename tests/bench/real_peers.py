"""Other focus stackers, where they are installed: enfuse after align_image_stack, and FocusWeave.

An executable is found on the path, or where an environment variable of its name in capitals says (ENFUSE, ALIGN_IMAGE_STACK, FOCUSWEAVE).
Their results lie on other pixels than our registered slices, so they are warped onto these first: SIFT, one affine map, Lanczos.
"""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from mrbokeh.images.color import display_rgb8, srgb_to_linear
from mrbokeh.system.atomic_files import read_json, write_json
from tests.bench.process_cost import Cost, attempted
from tests.bench.real_sets import RealStack
from tests.bench.real_stack import Rgb, linked

PEER_TIMEOUT_S = 1200.0
MOST_SLICES_MATCHED = 6
MOST_WORDS = 25
"""Of what a failed peer said last."""
FEATURES, RATIO, RANSAC_PX, FEWEST_MATCHES = 4000, 0.75, 1.0, 12

Affine = Float64[np.ndarray, "2 3"]


class PeerResult(NamedTuple):
    """picture: 8-bit sRGB and coverage as an image file, or None where the peer failed, which `said` tells."""

    picture: Path | None
    cpu_s: float
    memory_mb: float
    said: str


def executable(name: str) -> str | None:
    return os.environ.get(name.upper()) or shutil.which(name)


def _enfuse(photographs: Path, out: Path) -> list[Cost]:
    """The options that the manuals give for focus stacks; the field of view is not solved for where that fails, as it advises."""
    files = [str(path) for path in sorted(photographs.iterdir())]
    aligning, fusing = executable("align_image_stack"), executable("enfuse")
    assert aligning is not None and fusing is not None
    costs = []
    for breathing in (["-m"], []):
        costs.append(attempted([aligning, *breathing, "-a", str(out.parent / "aligned_"), *files], PEER_TIMEOUT_S))
        slices = [str(path) for path in sorted(out.parent.glob("aligned_*.tif"))]
        if not costs[-1].exit_code and len(slices) == len(files):
            weights = ["--exposure-weight=0", "--saturation-weight=0", "--contrast-weight=1", "--hard-mask"]
            return [*costs, attempted([fusing, *weights, "-o", str(out), *slices], PEER_TIMEOUT_S)]
    return costs


def _focusweave(photographs: Path, out: Path) -> list[Cost]:
    weaving = executable("focusweave")
    assert weaving is not None
    return [attempted([weaving, str(photographs), "--output", str(out)], PEER_TIMEOUT_S)]


PEERS: dict[str, tuple[tuple[str, ...], Callable[[Path, Path], list[Cost]]]] = {
    "FocusWeave": (("focusweave",), _focusweave),
    "enfuse": (("align_image_stack", "enfuse"), _enfuse),
}


def peers_present() -> dict[str, str]:
    """Return the version of each peer of which all programs are here."""
    return {name: _version(programs[-1]) for name, (programs, _) in PEERS.items() if all(executable(each) for each in programs)}


def _version(program: str) -> str:
    said = subprocess.run([executable(program) or program, "--version"], capture_output=True, text=True).stdout
    found = re.search(r"\d+(\.\d+)+", said)
    return found.group() if found else "of unknown version"


def peer_result(name: str, version: str, stack: RealStack, cache: Path) -> PeerResult:
    """Run a peer, or take what it made of the same photographs before."""
    folder = cache / "peers"
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"{stack.file_name}_{stack.digest}_{name}_{version}"
    picture, told = folder / f"{stem}.png", folder / f"{stem}.json"
    if not told.is_file():
        with tempfile.TemporaryDirectory() as work:
            photographs, out = linked(stack.photographs, Path(work) / "slices"), Path(work) / "result.png"
            costs = PEERS[name][1](photographs, out)
            if out.is_file() and not costs[-1].exit_code:
                cv2.imwrite(str(picture), _eight_bits(out))
            said = "" if picture.is_file() else f"exit {costs[-1].exit_code}: " + " ".join(costs[-1].said.split()[-MOST_WORDS:])
            write_json(told, {"cpu_s": sum(each.cpu_s for each in costs), "memory_mb": max(each.memory_mb for each in costs), "said": said})
    return PeerResult(picture if picture.is_file() else None, **read_json(told, "what a peer cost"))


def _eight_bits(path: Path) -> UInt8[np.ndarray, "height width channels"]:
    """Blue first, as OpenCV has it, with coverage where the file has it."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError(f"{path} is no picture that OpenCV reads")
    pixels = np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels
    return np.rint(pixels / 257.0).astype(np.uint8) if pixels.dtype == np.uint16 else pixels.astype(np.uint8)


class Features(NamedTuple):
    points: Float32[np.ndarray, "count 2"]
    descriptors: Float32[np.ndarray, "count 128"]


def features_of(bgr8: UInt8[np.ndarray, "height width channels"]) -> Features:
    grey = cv2.cvtColor(np.ascontiguousarray(bgr8[..., :3]), cv2.COLOR_BGR2GRAY)
    points, descriptors = cv2.SIFT_create(nfeatures=FEATURES).detectAndCompute(grey, None)  # type: ignore[attr-defined]
    if descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    return Features(np.array([point.pt for point in points], np.float32), descriptors)


def features_of_slices(slices: Iterable[Rgb], count: int) -> list[Features]:
    """Of slices evenly taken: what is sharp in none of them has no part in finding where a peer's picture lies."""
    wanted = set(np.linspace(0, count - 1, min(count, MOST_SLICES_MATCHED)).round().astype(int).tolist())
    return [features_of(display_rgb8(rgb)[..., ::-1]) for index, rgb in enumerate(slices) if index in wanted]


def slices_from_picture(picture: Features, slices: Iterable[Features]) -> Affine | None:
    """Return the affine map from a peer's pixels to those of the registered slices, or None where too little matches."""
    from_points, to_points = [], []
    for each in slices:
        if min(len(each.points), len(picture.points)) < 2:
            continue
        for best, second in cv2.BFMatcher().knnMatch(picture.descriptors, each.descriptors, k=2):
            if best.distance < RATIO * second.distance:
                from_points.append(picture.points[best.queryIdx])
                to_points.append(each.points[best.trainIdx])
    if len(from_points) < FEWEST_MATCHES:
        return None
    found, kept = cv2.estimateAffine2D(np.array(from_points), np.array(to_points), ransacReprojThreshold=RANSAC_PX, refineIters=50)
    return None if found is None or int(kept.sum()) < FEWEST_MATCHES else found


def on_slices(picture: Path, slices: Iterable[Features], size: tuple[int, int]) -> tuple[Rgb, Bool[np.ndarray, "height width"]] | None:
    """(a peer's picture in linear Rec.709 on the registered slices, which pixels it covers), or None where too little matches.

    size: (height, width) of the slices.
    """
    pixels = _eight_bits(picture)
    affine = slices_from_picture(features_of(pixels), slices)
    if affine is None:
        return None
    width_height = size[::-1]
    covered = pixels[..., 3] if pixels.shape[2] == 4 else np.full(pixels.shape[:2], 255, np.uint8)
    encoded = pixels[..., 2::-1].astype(np.float32) / np.float32(255.0)
    warped = cv2.warpAffine(encoded, affine, width_height, flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    known = cv2.warpAffine(covered, affine, width_height, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) == 255
    return srgb_to_linear(np.clip(warped, 0.0, 1.0)), known
