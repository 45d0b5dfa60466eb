"""A board as a PDF of vectors at true size, with a ruler that shows whether the printer kept it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mrbokeh.system.atomic_files import atomic_path, refuse_existing
from mrbokeh.system.errors import InputError, MissingExtraError
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.drawing import black_rectangles_mm

PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 10.0
"""What office printers leave white."""

RULER_MM = 100.0
_FOOT_MM = 22.0
_POINTS_PER_MM = 72.0 / 25.4


@dataclass(frozen=True)
class Page:
    """width_mm, height_mm of the paper, in the direction in which it is used."""

    width_mm: float
    height_mm: float

    @property
    def room_mm(self) -> tuple[float, float]:
        """What is left for a board between the margins and above ruler and text."""
        return self.width_mm - 2 * MARGIN_MM, self.height_mm - 2 * MARGIN_MM - _FOOT_MM

    def holds(self, size_mm: tuple[float, float]) -> bool:
        return size_mm[0] <= self.room_mm[0] + 1e-6 and size_mm[1] <= self.room_mm[1] + 1e-6

    @property
    def turned(self) -> "Page":
        return Page(self.height_mm, self.width_mm)


def page_of(paper: str) -> Page:
    """Upright."""
    if paper.lower() not in PAPERS_MM:
        raise InputError(f"expected a paper of {', '.join(PAPERS_MM)} or the word board (a page of its size), got {paper!r}")
    return Page(*PAPERS_MM[paper.lower()])


def page_for(board: CharucoBoard, paper: str) -> Page:
    """The paper turned so that the board fits; paper: a4, a3, letter, or board (a page made for it)."""
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
    """Refuses a board that does not fit, and an existing file without `overwrite`."""
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
    """All rectangles in one path: filled one by one, neighbours would show hairlines where they touch."""
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
    """A line for the board and one for its origin."""
    grids = [
        f"{grid.squares[0]}x{grid.squares[1]} squares of {grid.square_mm:g} mm, markers of {grid.marker_mm:g} mm" for grid in board.grids
    ]
    return [f"{board.dictionary}: " + "; ".join(grids), "Origin: the outer corner at the top left; x right, y down, z into the paper."]
