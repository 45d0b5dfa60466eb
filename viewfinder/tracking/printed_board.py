"""Printed boards: which one to print for a lens, a distance and a picture size, and its PDF at true size with a ruler.

The rule: a marker of the 4x4 dictionary (6 cells with its border) must span 6 diameters of the blur on the screen. On traced
pictures with discs of 4 to 12 px, 62 to 100 % of the corners were found at 6 diameters, 0 to 58 % at 4.5, none at 4.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.system.atomic_files import atomic_path, refuse_existing
from mrbokeh.system.errors import InputError, MissingExtraError
from mrbokeh.tracking.camera_track.board_calibration import FEWEST_CORNERS
from mrbokeh.tracking.charuco.board import DICTIONARY, CharucoBoard, CharucoGrid, black_rectangles_mm

PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 10.0
"""What office printers leave white."""

RULER_MM = 100.0
_FOOT_MM = 22.0
_POINTS_PER_MM = 72.0 / 25.4


@dataclass(frozen=True)
class Page:
    """Page with the width and height of the paper, in the direction in which it is used."""

    width_mm: float
    height_mm: float

    @property
    def room_mm(self) -> tuple[float, float]:
        """Room for a board between the margins and above ruler and text."""
        return self.width_mm - 2 * MARGIN_MM, self.height_mm - 2 * MARGIN_MM - _FOOT_MM

    def holds(self, size_mm: tuple[float, float]) -> bool:
        return size_mm[0] <= self.room_mm[0] + 1e-6 and size_mm[1] <= self.room_mm[1] + 1e-6

    @property
    def turned(self) -> "Page":
        return Page(self.height_mm, self.width_mm)


def page_of(paper: str) -> Page:
    """Return an upright page."""
    if paper.lower() not in PAPERS_MM:
        raise InputError(f"expected a paper of {', '.join(PAPERS_MM)} or the word board (a page of its size), got {paper!r}")
    return Page(*PAPERS_MM[paper.lower()])


def page_for(board: CharucoBoard, paper: str) -> Page:
    """Turn the paper so that the board fits; paper: a4, a3, letter, or board (a page made for it)."""
    size_mm = board.size_mm
    if paper.lower() == "board":
        return Page(max(size_mm[0], RULER_MM) + 2 * MARGIN_MM, size_mm[1] + 2 * MARGIN_MM + _FOOT_MM)
    upright = page_of(paper)
    for page in (upright, upright.turned):
        if page.holds(size_mm):
            return page
    room = " or ".join(f"{page.room_mm[0]:g}x{page.room_mm[1]:g}" for page in (upright, upright.turned))
    raise InputError(
        f"the board is {size_mm[0]:g}x{size_mm[1]:g} mm, but {paper} has room for {room} mm: "
        f"take smaller or fewer squares, a larger paper, or the paper board, which makes a page of its size for a print shop"
    )


def write_board_pdf(path: Path, board: CharucoBoard, paper: str = "a4", *, overwrite: bool = False) -> None:
    """Write a board; refuse one that does not fit, and an existing file without `overwrite`."""
    page = page_for(board, paper)
    refuse_existing(path, overwrite)
    try:
        from reportlab.pdfgen.canvas import Canvas
    except ImportError:
        raise MissingExtraError("reportlab", "viewfinder") from None
    with atomic_path(path) as temporary:
        size_points = page.width_mm * _POINTS_PER_MM, page.height_mm * _POINTS_PER_MM
        # Uncompressed, so that everybody can look at the numbers; invariant: the same board gives the same bytes.
        canvas = Canvas(str(temporary), pagesize=size_points, pageCompression=0, invariant=1)
        canvas.setTitle(f"Tracking board, {describe(board)[0]}")
        _draw_board(canvas, board, page)
        _draw_foot(canvas, board)
        canvas.save()


def _draw_board(canvas: Any, board: CharucoBoard, page: Page) -> None:
    """Draw all rectangles in one path: filled one by one, neighbours would show hairlines where they touch."""
    left_mm = (page.width_mm - board.size_mm[0]) / 2
    top_mm = page.height_mm - MARGIN_MM
    path = canvas.beginPath()
    for x, y, width, height in black_rectangles_mm(board).tolist():
        corner_mm = left_mm + x, top_mm - y - height
        path.rect(*(each * _POINTS_PER_MM for each in (*corner_mm, width, height)))
    canvas.setFillGray(0.0)
    canvas.drawPath(path, fill=1, stroke=0)


def _draw_foot(canvas: Any, board: CharucoBoard) -> None:
    base = MARGIN_MM + 14.0
    canvas.setLineWidth(0.2 * _POINTS_PER_MM)
    marks = [(MARGIN_MM, base, MARGIN_MM + RULER_MM, base)]
    marks += [(x, base, x, base + (4.0 if each % 5 == 0 else 2.5)) for each in range(11) for x in (MARGIN_MM + 10.0 * each,)]
    canvas.lines([tuple(end * _POINTS_PER_MM for end in mark) for mark in marks])
    canvas.setFont("Helvetica", 7)
    lines = [
        f"This ruler must be {RULER_MM:g} mm long: print at 100 %, without fitting to the page, and lay the paper flat.",
        *describe(board),
    ]
    for number, line in enumerate(lines):
        canvas.drawString(MARGIN_MM * _POINTS_PER_MM, (base - 4.0 - 3.0 * number) * _POINTS_PER_MM, line)


def describe(board: CharucoBoard) -> list[str]:
    """Return a line for the board and one for its origin."""
    grids = [
        f"{grid.squares[0]}x{grid.squares[1]} squares of {grid.square_mm:g} mm, markers of {grid.marker_mm:g} mm" for grid in board.grids
    ]
    return [f"{board.dictionary}: " + "; ".join(grids), "Origin: the outer corner at the top left; x right, y down, z into the paper."]


BLURS_PER_MARKER = 6.0
SHARP_MARKER_PX = 24.0
"""Of a sharp marker: 4 px for each of its cells."""

MARKER_PER_SQUARE = 0.75
_FEWEST_COLUMNS, _FEWEST_ROWS = 4, 3
_MOST_COLUMNS, _MOST_ROWS = 9, 7
_WORTH_A_SECOND_SCALE = 1.8
_GAP_SQUARES = 0.25
_STEPS = 33


@dataclass(frozen=True)
class BoardView:
    """View of a board: from nearest_m to farthest_m, in pictures width_px wide, elevation_deg above its plane."""

    lens: Lens
    nearest_m: float
    farthest_m: float
    width_px: int
    elevation_deg: float = 45.0

    def __post_init__(self) -> None:
        if not (0.0 < self.nearest_m <= self.farthest_m < np.inf and 0.0 < self.elevation_deg <= 90.0 and self.width_px > 0):
            raise InputError(
                f"expected 0 < nearest <= farthest distance, an elevation of 0 to 90 degrees and a width in pixels, got "
                f"{self.nearest_m:g} to {self.farthest_m:g} m, {self.elevation_deg:g} degrees, {self.width_px} px"
            )

    def needed_marker_mm(self, distance_m: float) -> float:
        """Return the least marker at that distance; its shorter side on the screen counts, which the elevation foreshortens."""
        needed_px = max(BLURS_PER_MARKER * abs(float(self.lens.coc_px(distance_m, self.width_px))), SHARP_MARKER_PX)
        return needed_px / self.px_per_mm(distance_m) / float(np.sin(np.deg2rad(self.elevation_deg)))

    def px_per_mm(self, distance_m: float) -> float:
        return self.lens.focal_px(self.width_px) / (distance_m * MM_PER_M)


@dataclass(frozen=True)
class BoardPlan:
    """Plan of a board.

    marker_mm: the least that is read at every distance. blur_px: the largest blur. board: None where no paper holds one.

    paper: the one to print on. sentence: all of it, for people.
    """

    marker_mm: float
    blur_px: float
    board: CharucoBoard | None
    paper: str | None
    sentence: str


def plan_board(view: BoardView, paper: str = "a4") -> BoardPlan:
    """Plan a board for that paper, or for the next larger one where its markers would be too small."""
    distances_m = [1.0 / float(each) for each in np.linspace(1.0 / view.farthest_m, 1.0 / view.nearest_m, _STEPS)]
    markers_mm = [view.needed_marker_mm(each) for each in distances_m]
    blur_px = max(abs(float(view.lens.coc_px(each, view.width_px))) for each in distances_m)
    needed = (
        f"from {view.nearest_m:g} to {view.farthest_m:g} m the blur grows to {blur_px:.1f} px, so markers must be at least "
        f"{max(markers_mm):.0f} mm ({BLURS_PER_MARKER:g} blurs)"
    )
    for name in _from(paper):
        board = _board_on(page_of(name), max(markers_mm), min(markers_mm))
        if board is not None:
            larger = "" if name == paper.lower() else f", which {paper} cannot hold"
            told = f"{needed}{larger}: print {_words(board)} on {name}{_calibrating(board)}"
            return BoardPlan(marker_mm=max(markers_mm), blur_px=blur_px, board=board, paper=name, sentence=told)
    advice = "stop the lens down, stay nearer to its focus, or track with a phone on the camera, whose own lens is sharp at all distances"
    return BoardPlan(
        marker_mm=max(markers_mm), blur_px=blur_px, board=None, paper=None, sentence=f"{needed}, which no paper up to a3 holds: {advice}"
    )


def _calibrating(board: CharucoBoard) -> str:
    """Return the warning that a clip of the board cannot tell the camera's intrinsics; empty if it can at every distance."""
    corners = _coarse_corners(board)
    if corners >= FEWEST_CORNERS:
        return ""
    where = "where the blur is strongest " if len(board.grids) > 1 else ""
    return f"; {where}its {corners} corners are too few for `mrbokeh track clip --calibrate` ({FEWEST_CORNERS}): give it --camera"


def _coarse_corners(board: CharucoBoard) -> int:
    """Count the corners that are read at every distance."""
    return int(np.count_nonzero(board.grid_of_corner == 0))


def _from(paper: str) -> list[str]:
    """Return that paper and larger ones."""
    wanted = page_of(paper)
    larger = [name for name, (width, height) in PAPERS_MM.items() if width * height > wanted.width_mm * wanted.height_mm]
    return [paper.lower(), *sorted(larger, key=lambda name: PAPERS_MM[name])]


def _board_on(page: Page, coarse_mm: float, fine_mm: float) -> CharucoBoard | None:
    """Return the board of the paper's direction with more corners."""
    boards = [board for each in (page, page.turned) if (board := _board_in(each.room_mm, coarse_mm, fine_mm)) is not None]
    return max(boards, key=lambda board: len(board.corners_m), default=None)


def _board_in(room_mm: tuple[float, float], coarse_mm: float, fine_mm: float) -> CharucoBoard | None:
    """Return one grid, and a fine one below it where the distances differ so much that small markers are read at some of them.

    Enough corners at every distance go before a second scale.
    """
    square_mm = _whole_mm(coarse_mm / MARKER_PER_SQUARE)
    columns = min(int(room_mm[0] / square_mm), _MOST_COLUMNS)
    rows = min(int(room_mm[1] / square_mm), _MOST_ROWS)
    if columns < _FEWEST_COLUMNS or rows < _FEWEST_ROWS:
        return None
    enough_rows = max(int(np.ceil(FEWEST_CORNERS / (columns - 1))) + 1, _FEWEST_ROWS)
    one_scale = (_grid(columns, rows, square_mm),)
    two_scales = [
        (coarse, fine)
        for coarse in (_grid(columns, each, square_mm) for each in {enough_rows, _FEWEST_ROWS} if each <= rows)
        if (fine := _below(coarse, room_mm, _whole_mm(fine_mm / MARKER_PER_SQUARE))) is not None
    ]
    wanted = sorted(two_scales, key=lambda grids: -grids[0].squares[1])
    boards = [_within_dictionary(grids) for grids in (*wanted, one_scale)]
    return next((board for board in boards if _coarse_corners(board) >= FEWEST_CORNERS), boards[0])


def _below(coarse: CharucoGrid, room_mm: tuple[float, float], square_mm: float) -> CharucoGrid | None:
    """Return a fine grid in what is left of the room; None where that is too little, or its squares are hardly smaller."""
    top_mm = coarse.size_mm[1] + _GAP_SQUARES * coarse.square_mm
    columns = min(int(room_mm[0] / square_mm), _MOST_COLUMNS)
    rows = min(int((room_mm[1] - top_mm) / square_mm), _MOST_ROWS)
    hardly_smaller = coarse.square_mm / square_mm < _WORTH_A_SECOND_SCALE
    if hardly_smaller or columns < _FEWEST_COLUMNS or rows < _FEWEST_ROWS:
        return None
    return CharucoGrid(
        squares=(columns, rows),
        square_mm=square_mm,
        marker_mm=MARKER_PER_SQUARE * square_mm,
        offset_mm=(0.0, top_mm),
        first_marker=coarse.marker_ids.stop,
    )


def _grid(columns: int, rows: int, square_mm: float) -> CharucoGrid:
    return CharucoGrid((columns, rows), square_mm, MARKER_PER_SQUARE * square_mm)


def _within_dictionary(grids: tuple[CharucoGrid, ...]) -> CharucoBoard:
    """Choose the smallest dictionary, whose markers differ most."""
    needed = max(grid.marker_ids.stop for grid in grids)
    return CharucoBoard(grids, DICTIONARY if needed <= 50 else "DICT_4X4_100")


def _whole_mm(size_mm: float) -> float:
    return float(np.ceil(size_mm - 1e-9))


def _words(board: CharucoBoard) -> str:
    return " and ".join(f"{grid.squares[0]}x{grid.squares[1]} squares of {grid.square_mm:g} mm" for grid in board.grids)
