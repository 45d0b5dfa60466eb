"""Draw the world of a camera track into frames of its clip: a track that is right holds the axes where they are, in every frame.

    python -m datasets_scripts.track_picture clip.mp4 track.json track.png --at 0.084,0.12,0 --size-m 0.08

Blue points up, as the track says where up is; red and green are the other two of the world's axes. They begin at --at, in the middle of
a yellow square in the ground.
"""

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from jaxtyping import Float64, UInt8

from datasets_scripts.made_sets.set_files import Overwrite, mistakes_told
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import atomic_path, refuse_existing
from mrbokeh.system.typed_numbers import numbers_in
from mrbokeh.tracking.camera_track.formats import read_track
from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.video.clip import read_frames

_SHARES = (0.1, 0.5, 0.9)
_YELLOW, _RED, _GREEN, _BLUE = (255, 210, 0), (255, 40, 40), (40, 220, 40), (60, 110, 255)
_SUBPIXEL_BITS = 4

Picture = UInt8[np.ndarray, "height width 3"]
Vector = Float64[np.ndarray, "3"]
Axes = Float64[np.ndarray, "3 3"]


def with_axes(rgb: Picture, camera: Camera, axes_m: Axes, at_m: Vector) -> Picture:
    """Return a copy with the axes from `at_m` on, in the world's metres. Lines with an end behind the camera are left out."""
    drawn = rgb.copy()
    one, other, _ = axes_m
    corners = [at_m + sides for sides in (one + other, one - other, -one - other, -one + other)]
    for begin, end in zip(corners, corners[1:] + corners[:1], strict=True):
        _draw_line(drawn, camera, np.stack([begin, end]), _YELLOW)
    for axis, colour in zip(axes_m, (_RED, _GREEN, _BLUE), strict=True):
        _draw_line(drawn, camera, np.stack([at_m, at_m + axis]), colour)
    return drawn


def axes_of(up: str, size_m: float) -> Axes:
    """Return rows: the two axes of the ground, then up. up: as of a CameraTrack, such as -z."""
    upward = "xyz".index(up[1])
    ground = [number for number in range(3) if number != upward]
    signs = np.array([1.0, 1.0, -1.0 if up[0] == "-" else 1.0])
    return np.eye(3)[[*ground, upward]] * signs[:, None] * size_m


def track_sheet(clip: Path, track: CameraTrack, at_m: Vector, size_m: float) -> Picture:
    """Return three frames of the clip side by side. Raises InputError where the track has no camera of one of them."""
    frames = [np.round(linear_to_srgb(np.clip(frame.rgb, 0.0, 1.0)) * 255.0).astype(np.uint8) for frame in read_frames(clip)]
    chosen = [round(share * (len(frames) - 1)) for share in _SHARES]
    axes_m = axes_of(track.up, size_m)
    return np.concatenate([with_axes(frames[number], track.at(number).camera, axes_m, at_m) for number in chosen], axis=1)


def _draw_line(rgb: Picture, camera: Camera, ends_m: Float64[np.ndarray, "2 3"], colour: tuple[int, int, int]) -> None:
    pixels, depth_m = camera.project(ends_m)
    if (depth_m <= 0.0).any():
        return
    # OpenCV's pixel (0, 0) has its centre at (0, 0), ours at (0.5, 0.5).
    begin, end = np.rint((pixels - 0.5) * 2**_SUBPIXEL_BITS).astype(int).tolist()
    cv2.line(rgb, begin, end, colour, 2, cv2.LINE_AA, _SUBPIXEL_BITS)


def main(
    clip: Annotated[Path, typer.Argument(help="The clip.")],
    track: Annotated[Path, typer.Argument(help="Its camera track, in any format of `mrbokeh track`.")],
    out: Annotated[Path, typer.Argument(help="Picture to write (.png, .jpg).")],
    at: Annotated[str, typer.Option(help="X,Y,Z in metres where the axes begin.")] = "0,0,0",
    size_m: Annotated[float, typer.Option(help="Length of an axis.")] = 0.1,
    overwrite: Overwrite = False,
) -> None:
    """Draw the axes of a track's world into three frames of its clip."""
    with mistakes_told():
        refuse_existing(out, overwrite)
        sheet = track_sheet(clip, read_track(track), _vector(at), size_m)
        with atomic_path(out) as temporary:
            temporary.write_bytes(cv2.imencode(out.suffix, np.ascontiguousarray(sheet[..., ::-1]))[1].tobytes())
    typer.echo(f"wrote {out}")


def _vector(text: str) -> Vector:
    return np.array(numbers_in(text, "expected --at X,Y,Z in metres, such as 0.1,0.05,0", (3,)))


if __name__ == "__main__":
    typer.run(main)
