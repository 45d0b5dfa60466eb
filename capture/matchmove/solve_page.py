"""The page of a match-move, in one file: how every frame fits, a grid on the ground, and the worst frames with what is off."""

from collections.abc import Collection, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from capture.matchmove.clip_matchmove import Matchmove
from capture.matchmove.clip_solve import ClipSolve
from capture.matchmove.keyframes import view_name
from capture.poses.sparse_model import SparseView
from capture.report.stack_section import Axes, chart
from mrbokeh.system.console import track
from mrbokeh.system.html_page import inline_figure, section, write_page
from mrbokeh.video.clip import probe, read_display_frames

_WIDTH_PX = 960
_QUALITY = 85
_SHOWN, _WORST = 4, 3
_HALF_CELLS, _STEPS = 8, 160
_GRID, _AXES, _OFF = (90, 255, 90), ((60, 60, 255), (255, 160, 40)), (60, 60, 255)
_ENLARGED = 10

Picture = UInt8[np.ndarray, "height width 3"]


def write_solve_page(path: Path, clip: Path, made: Matchmove) -> None:
    """Write the page; pictures are taken from the clip."""
    solve, info = made.solve, probe(clip)
    numbers = sorted(solve.fits)
    shown = sorted({numbers[round(share * (len(numbers) - 1))] for share in np.linspace(0.0, 1.0, _SHOWN)})
    worst = _worst(solve)
    pictures = dict(_pictures(clip, {*shown, *worst}, info.width_px, info.height_px))
    fits = [solve.fits[number] for number in numbers]
    x = [float(number) for number in numbers]
    charts = [
        chart(Axes("Residual of what rests", "frame", "px"), x, {"median": [each.residual_px for each in fits]}),
        chart(Axes("Features that the camera explains", "frame", "%"), x, {"share": [100.0 * each.fitting for each in fits]}),
    ]
    lost = f" Lost frames: {', '.join(map(str, solve.lost))}." if solve.lost else ""
    told = f"Solved as {solve.why}. {len(numbers)} of {len(solve.times_s)} frames.{lost} {' '.join(f'{each}.' for each in solve.warnings)}"
    on_ground = "Cells are of equal size on the ground; x is red, y blue. The grid must stay where it is on what rests."
    blocks = [section(f"{clip.name}: its camera", told, charts)]
    if made.has_ground:
        grid = _grid(solve)
        drawn = [_figure(_with_grid(pictures[n], solve.model.view(view_name(n)), grid), f"frame {n}") for n in shown]
        blocks.append(section("A grid on the ground", on_ground, drawn))
    figures = [_figure(_with_features(pictures[n], solve, n), f"frame {n}: {solve.fits[n].residual_px:.2f} px") for n in worst]
    explained = f"Features at rest as circles; lines are what is left of them, {_ENLARGED} times as long."
    blocks.append(section("The keyframes that fit worst", explained, figures))
    write_page(path, f"{clip.name}: its camera", blocks)


def _worst(solve: ClipSolve) -> list[int]:
    """Return keyframes, for which the model keeps features."""
    keyframes = [number for number in solve.keyframes if number in solve.fits]
    return sorted(keyframes, key=lambda number: -solve.fits[number].residual_px)[:_WORST]


def _pictures(clip: Path, wanted: Collection[int], width_px: int, height_px: int) -> Iterator[tuple[int, Picture]]:
    factor = min(1.0, _WIDTH_PX / width_px)
    frames = read_display_frames(clip, round(factor * width_px), round(factor * height_px))
    for number, frame in enumerate(track(frames, "page", max(wanted) + 1)):
        if number in wanted:
            yield number, frame.bgr
        if number == max(wanted):
            return


def _grid(solve: ClipSolve) -> Float64[np.ndarray, "lines steps 3"]:
    """Return lines on the ground about the origin, those of x = 0 and z = 0 in the middle of each half; y is down."""
    first = solve.model.view(view_name(min(solve.fits))).camera
    cell = float(np.linalg.norm(first.camera_from_world[:3, 3])) * first.width_px / first.focal_px[0] / _HALF_CELLS
    along = np.linspace(-_HALF_CELLS, _HALF_CELLS, _STEPS) * cell
    places = np.arange(-_HALF_CELLS, _HALF_CELLS + 1) * cell
    level = np.zeros((len(places), _STEPS))
    fixed, moving = np.repeat(places[:, None], _STEPS, axis=1), np.repeat(along[None], len(places), axis=0)
    return np.concatenate([np.stack([moving, level, fixed], axis=2), np.stack([fixed, level, moving], axis=2)])


def _with_grid(picture: Picture, view: SparseView, lines: Float64[np.ndarray, "lines steps 3"]) -> Picture:
    drawn, factor = picture.copy(), picture.shape[1] / view.camera.width_px
    middles = (len(lines) // 4, len(lines) // 4 + len(lines) // 2)
    for number, line in enumerate(lines):
        # Distortion folds far beyond the picture: what is far off without it is not drawn.
        straight_px, depth = view.camera.project(line)
        xy_px, middle_px = view.project(line)[0], np.array(view.camera.principal_px)
        near = (depth > 0) & (np.abs(straight_px - middle_px) < 1.5 * middle_px).all(axis=1)
        colour = _AXES[middles.index(number)] if number in middles else _GRID
        for run in np.split(np.arange(len(line)), np.flatnonzero(np.diff(near)) + 1):
            if near[run[0]] and len(run) > 1:
                cv2.polylines(drawn, [np.round(16.0 * factor * xy_px[run]).astype(np.int32)], False, colour, 1, cv2.LINE_AA, 4)
    return drawn


def _with_features(picture: Picture, solve: ClipSolve, number: int) -> Picture:
    model, view = solve.model, solve.model.view(view_name(number))
    drawn, factor = picture.copy(), picture.shape[1] / view.camera.width_px
    rows = model.observations[:, 0] == model.index_of(view.name)
    seen_px = model.observed_xy_px[rows]
    off_px = view.project(model.points[model.observations[rows, 1]])[0] - seen_px
    for (x, y), (right, down) in zip(factor * seen_px, _ENLARGED * factor * off_px, strict=True):
        cv2.circle(drawn, (int(x), int(y)), 3, _GRID, 1, cv2.LINE_AA)
        cv2.line(drawn, (int(x), int(y)), (int(x + right), int(y + down)), _OFF, 1, cv2.LINE_AA)
    return drawn


def _figure(picture: Picture, caption: str) -> str:
    _, encoded = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
    return inline_figure(encoded.tobytes(), "jpeg", caption)
