"""Other flat prints than ChArUco boards: plain chessboards, grids of tags, and any picture; and how each print is found in frames.

A board file says by its `kind` what is printed; without one it is a ChArUco board (`charuco.board`). As TOML:

    kind = "chessboard"          kind = "tags"
    squares = [9, 6]             tags = [6, 4]                     # columns, rows
    square_mm = 30.0             tag_mm = 24.0                     # side of the black square
                                 gap_mm = 7.2                      # between two of them
                                 dictionary = "DICT_APRILTAG_36h11"
                                 first_marker = 0                  # ids go on from there, row by row from the top left

Axes and places are those of `charuco.board`: the origin is the outer top left corner of the first square or tag, or of the picture. A
chessboard's first square is black; one that looks alike after half a turn (both numbers even or both odd) is taken to begin at the top left
of the first frame that shows it, and keeps that way round.
"""

import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import FEWEST_SQUARES, CharucoBoard, read_board
from mrbokeh.tracking.charuco.board_alignment import aligned_corners
from mrbokeh.tracking.charuco.detector import NO_CORNERS, CharucoDetector, Corners, Grey, flow

_TAGS = "DICT_APRILTAG_36h11"


@runtime_checkable
class Finder(Protocol):
    """Search for a print in frames. Not to be shared between threads."""

    def detect(self, grey: Grey, /) -> Corners:
        """Find the print in a frame by itself."""

    def aligned(self, grey: Grey, start: Corners, /) -> Corners | None:
        """Return all corners by laying the print over the frame, starting from some; None if it does not fit, or there is no such way."""


@dataclass(frozen=True)
class Chessboard:
    """Chessboard without markers. squares: (columns, rows)."""

    squares: tuple[int, int]
    square_mm: float

    def __post_init__(self) -> None:
        if min(self.squares) < FEWEST_SQUARES + 1 or not 0.0 < self.square_mm < float("inf"):
            squares = f"{self.squares[0]}x{self.squares[1]} of {self.square_mm:g} mm"
            raise InputError(f"a chessboard needs 4x4 squares or more, above 0 mm, got {squares}")

    @property
    def size_mm(self) -> tuple[float, float]:
        return self.squares[0] * self.square_mm, self.squares[1] * self.square_mm

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corners 3"]:
        """Return the places of the inner corners, row by row; z = 0."""
        x, y = np.meshgrid(np.arange(1, self.squares[0]), np.arange(1, self.squares[1]))
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * self.square_mm / MM_PER_M

    @property
    def described(self) -> str:
        return f"the chessboard of {self.squares[0]}x{self.squares[1]} squares"


@dataclass(frozen=True)
class TagGrid:
    """Grid of ArUco markers or AprilTags. tags: (columns, rows). dictionary: a name in cv2.aruco."""

    tags: tuple[int, int]
    tag_mm: float
    gap_mm: float
    dictionary: str = _TAGS
    first_marker: int = 0

    def __post_init__(self) -> None:
        if min(self.tags) < 1 or self.tags[0] * self.tags[1] < 2 or self.first_marker < 0:
            raise InputError(f"a grid of tags needs two tags or more, with ids from 0 up, got {self.tags[0]}x{self.tags[1]}")
        if not 0.0 < self.tag_mm < float("inf") or not 0.0 < self.gap_mm < float("inf"):
            raise InputError(f"a grid of tags needs tags and gaps above 0 mm, got {self.tag_mm:g} and {self.gap_mm:g}")
        if not (self.dictionary.startswith("DICT_") and hasattr(cv2.aruco, self.dictionary)):
            raise InputError(f"expected a dictionary of cv2.aruco such as {_TAGS} or DICT_5X5_100, got {self.dictionary!r}")

    @property
    def size_mm(self) -> tuple[float, float]:
        width, height = (count * (self.tag_mm + self.gap_mm) - self.gap_mm for count in self.tags)
        return width, height

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corners 3"]:
        """Return four corners of each tag, from the top left clockwise; z = 0."""
        x, y = np.meshgrid(np.arange(self.tags[0]), np.arange(self.tags[1]))
        origins = np.stack([x.ravel(), y.ravel()], axis=1)[:, None] * (self.tag_mm + self.gap_mm)
        corners = origins + self.tag_mm * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        return np.pad(corners.reshape(-1, 2), ((0, 0), (0, 1))) / MM_PER_M

    @property
    def described(self) -> str:
        return f"the grid of {self.tags[0]}x{self.tags[1]} tags, {self.dictionary}"


_PICTURE_PX, _PICTURE_POINTS, _APART_PX = 1000, 300, 8
_FEWEST_FEATURES = 40


@dataclass(frozen=True, eq=False)
class FlatPicture:
    """Printed picture, grey and at most 1000 px wide or high. width_m: of the print."""

    grey: UInt8[np.ndarray, "height width"]
    width_m: float
    name: str = "the picture"

    @property
    def size_mm(self) -> tuple[float, float]:
        return self.width_m * MM_PER_M, self.width_m * MM_PER_M * self.grey.shape[0] / self.grey.shape[1]

    @cached_property
    def points_px(self) -> Float64[np.ndarray, "corners 2"]:
        """Return the places in it that are followed."""
        found = cv2.goodFeaturesToTrack(self.grey, _PICTURE_POINTS, 0.01, _APART_PX)
        if found is None or len(found) < _FEWEST_FEATURES:
            raise InputError(
                f"{self.name} has {0 if found is None else len(found)} corners to follow, at least {_FEWEST_FEATURES} are needed: "
                f"print something with more detail"
            )
        return found.reshape(-1, 2).astype(np.float64) + 0.5

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corners 3"]:
        return np.pad(self.points_px, ((0, 0), (0, 1))) * self.width_m / self.grey.shape[1]

    @property
    def described(self) -> str:
        return self.name


FlatPrint = CharucoBoard | Chessboard | TagGrid | FlatPicture


def read_picture(path: Path, width_m: float) -> FlatPicture:
    """Read a picture that was printed so wide."""
    from mrbokeh.images.color import display_rgb8
    from mrbokeh.images.image_io import read_image

    if not 0.0 < width_m < float("inf"):
        raise InputError(f"--width: expected the width of the printed picture in metres, above 0, got {width_m:g}")
    grey = cv2.cvtColor(display_rgb8(read_image(path)), cv2.COLOR_RGB2GRAY)
    factor = min(1.0, _PICTURE_PX / max(grey.shape))
    grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1.0 else grey
    return FlatPicture(np.asarray(grey, np.uint8), width_m, str(path))


_KINDS: dict[str, tuple[type[Chessboard] | type[TagGrid], tuple[str, ...]]] = {
    "chessboard": (Chessboard, ("squares", "square_mm")),
    "tags": (TagGrid, ("tags", "tag_mm", "gap_mm", "dictionary", "first_marker")),
}


def read_print(path: Path) -> FlatPrint:
    """Read a board file of any kind."""
    document = _document(path)
    if not isinstance(document, dict) or "kind" not in document:
        return read_board(path)
    kind = document.pop("kind")
    if kind not in _KINDS:
        raise InputError(f"{path}: expected kind to be {' or '.join(_KINDS)}, or none for a ChArUco board, got {kind!r}")
    made, keys = _KINDS[kind]
    if unknown := set(document) - set(keys):
        raise InputError(f"{path}: a board of kind {kind} has {', '.join(keys)}, got {', '.join(sorted(unknown))}")
    try:
        columns, rows = (int(each) for each in document.pop(keys[0]))
        words = {key: document.pop(key) for key in ("dictionary", "first_marker") if key in document}
        return made((columns, rows), **{key: float(value) for key, value in document.items()}, **words)  # type: ignore[arg-type]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from None
        raise InputError(f"{path}: expected {keys[0]} = [columns, rows], and {', '.join(keys[1:3])} in mm ({error})") from None


def _document(path: Path) -> Any:
    if path.suffix.lower() != ".toml":
        return read_json(path, "a board")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return None  # read_board says what is wrong


def finder_of(printed: FlatPrint) -> Finder:
    """Return the search for a print."""
    if isinstance(printed, Chessboard):
        return _ChessboardFinder(printed)
    if isinstance(printed, TagGrid):
        return _TagFinder(printed)
    return _PictureFinder(printed) if isinstance(printed, FlatPicture) else _CharucoFinder(printed)


class _CharucoFinder:
    def __init__(self, board: CharucoBoard) -> None:
        self._board, self._detector = board, CharucoDetector(board)

    def detect(self, grey: Grey) -> Corners:
        return self._detector.detect(grey)

    def aligned(self, grey: Grey, start: Corners) -> Corners | None:
        return aligned_corners(self._board, grey, start)


_CHESSBOARD_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
_SAME_PX = 4.0


class _ChessboardFinder:
    """OpenCV's search by sectors (Duda and Frese 2018), which finds all corners or none."""

    def __init__(self, board: Chessboard) -> None:
        self._board = board
        columns, rows = board.squares
        self._tells = (columns + rows) % 2 == 1
        self._before: Corners | None = None

    def detect(self, grey: Grey) -> Corners:
        columns, rows = self._board.squares
        found, xy_px = cv2.findChessboardCornersSB(grey, (columns - 1, rows - 1), flags=_CHESSBOARD_FLAGS)
        if not found or xy_px is None or len(np.ravel(xy_px)) != 2 * len(self._board.corners_m):
            return NO_CORNERS
        places = np.asarray(xy_px, np.float64).reshape(-1, 2) + 0.5
        corners = Corners(np.arange(len(places)), places)
        turned = Corners(np.arange(len(places)), places[::-1])
        if self._tells:
            corners = max((corners, turned), key=lambda each: self._blackness(grey, each))
        elif self._before is None:
            corners = min((corners, turned), key=lambda each: float(each.xy_px[0].sum()))
        else:
            before = self._before.xy_px
            corners = min((corners, turned), key=lambda each: float(np.linalg.norm(each.xy_px - before)))
        self._before = corners
        return corners

    def aligned(self, _grey: Grey, _start: Corners) -> Corners | None:
        return None

    def _blackness(self, grey: Grey, corners: Corners) -> float:
        """Return how much darker squares are that should be black than their neighbours."""
        columns, rows = self._board.squares
        x, y = np.meshgrid(np.arange(1, columns - 1) + 0.5, np.arange(1, rows - 1) + 0.5)
        places = np.stack([x.ravel(), y.ravel()], axis=1) * self._board.square_mm
        homography, _ = cv2.findHomography(MM_PER_M * self._board.corners_m[:, :2], corners.xy_px - 0.5)
        seen = cv2.perspectiveTransform(places[None], homography)[0].astype(np.float32)
        values = cv2.remap(grey, seen[None, :, 0].copy(), seen[None, :, 1].copy(), cv2.INTER_LINEAR)[0].astype(np.float64)
        black = ((np.floor(x) + np.floor(y)) % 2 == 0).ravel()
        return float(values[~black].mean() - values[black].mean())


class _TagFinder:
    def __init__(self, board: TagGrid) -> None:
        self._board = board
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(self, grey: Grey) -> Corners:
        corners, ids, _ = self._detector.detectMarkers(grey)
        found = NO_CORNERS
        for number, places in zip(np.ravel(ids) if len(corners) else (), corners, strict=True):
            tag = int(number) - self._board.first_marker
            if 0 <= tag < self._board.tags[0] * self._board.tags[1]:
                found = found.with_more(Corners(4 * tag + np.arange(4), np.asarray(places, np.float64).reshape(4, 2) + 0.5))
        return found

    def aligned(self, _grey: Grey, _start: Corners) -> Corners | None:
        return None


_ENLARGED_UP_TO_PX = 640
_RATIO, _WRONG_PX, _FEWEST_MATCHES, _FEWEST_SHARE, _SURE_SHARE = 0.75, 3.0, 12, 0.3, 0.6
_LEAST_SCALE = 0.05
_SMOOTHED_PX = (0.0, 2.0)
"""Of the print and the frame before flow: a frame blurred by motion has little in common with a sharp print."""


def _stretched(grey: Grey) -> Grey:
    """Return the frame with its whole range of brightness: SIFT and flow find nothing in a dim one."""
    low, high = np.percentile(grey[::4, ::4], (1.0, 99.5))
    return cv2.convertScaleAbs(np.clip(grey, low, high) - low, alpha=255.0 / max(high - low, 8.0))


class _PictureFinder:
    """SIFT (Lowe 2004) finds the picture; laid over the frame, its points are then found where flow takes them from there."""

    def __init__(self, picture: FlatPicture) -> None:
        self._picture, self._sift = picture, cv2.SIFT.create(nfeatures=2000)
        keypoints, self._descriptors = self._sift.detectAndCompute(picture.grey, None)
        self._places = np.array([each.pt for each in keypoints])
        self._matcher = cv2.BFMatcher(cv2.NORM_L2)
        self._before: np.ndarray | None = None

    def detect(self, grey: Grey) -> Corners:
        grey = _stretched(grey)
        if self._before is not None and (near := self._laid_over(grey, self._before, _SURE_SHARE)) is not None:
            return near
        enlarged = 2 if max(grey.shape) <= _ENLARGED_UP_TO_PX else 1
        searched = cv2.resize(grey, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC) if enlarged > 1 else grey
        keypoints, descriptors = self._sift.detectAndCompute(searched, None)
        if descriptors is None or len(keypoints) < _FEWEST_MATCHES:
            return NO_CORNERS
        pairs = [each for each in self._matcher.knnMatch(self._descriptors, descriptors, 2) if len(each) == 2]
        good = [one for one, other in pairs if one.distance < _RATIO * other.distance]
        if len(good) < _FEWEST_MATCHES:
            return NO_CORNERS
        there = (np.array([keypoints[each.trainIdx].pt for each in good]) + 0.5) / enlarged - 0.5
        homography, kept = cv2.findHomography(self._places[[each.queryIdx for each in good]], there, cv2.USAC_MAGSAC, _WRONG_PX)
        if homography is None or np.count_nonzero(kept) < _FEWEST_MATCHES:
            return NO_CORNERS
        return self._laid_over(grey, homography) or NO_CORNERS

    def aligned(self, grey: Grey, start: Corners) -> Corners | None:
        if len(start) < _FEWEST_MATCHES:
            return None
        homography, _ = cv2.findHomography(self._picture.points_px[start.ids] - 0.5, start.xy_px - 0.5, cv2.USAC_MAGSAC, _WRONG_PX)
        return None if homography is None else self._laid_over(_stretched(grey), homography)

    def _laid_over(self, grey: Grey, frame_from_picture: np.ndarray, least_share: float = _FEWEST_SHARE) -> Corners | None:
        """Return the picture's points where flow from the warped picture finds them; None if too few are found nearby."""
        height, width = grey.shape
        warped, seen = self._warped(frame_from_picture, (width, height))
        if warped is None:
            return None
        start = cv2.perspectiveTransform((self._picture.points_px - 0.5)[None], frame_from_picture)[0] + 0.5
        ids = np.flatnonzero(np.isfinite(start).all(axis=1) & (start > 4).all(axis=1) & (start < (width - 4, height - 4)).all(axis=1))
        if len(ids) < _FEWEST_MATCHES:
            return None
        # Flow takes brightness as it is: the print is given the frame's, and the frame around it.
        (middle, spread), (wanted, wanted_spread) = ((values.mean(), values.std() + 1.0) for values in (warped[seen], grey[seen]))
        shown = np.where(seen, np.clip((warped - middle) * (wanted_spread / spread) + wanted, 0, 255).astype(np.uint8), grey)
        for sigma_px in _SMOOTHED_PX:
            one, other = ((each if not sigma_px else cv2.GaussianBlur(each, (0, 0), sigma_px)) for each in (shown, grey))
            places, good = flow(one, other, start[ids])
            good &= np.linalg.norm(places - start[ids], axis=1) < 2.0 * _WRONG_PX
            if np.count_nonzero(good) >= max(_FEWEST_MATCHES, least_share * len(ids)):
                self._before = frame_from_picture
                return Corners(ids[good], places[good])
        return None

    def _warped(self, frame_from_picture: np.ndarray, size_px: tuple[int, int]) -> tuple[np.ndarray | None, np.ndarray]:
        """Return (the picture as the frame would see it, where it is seen); None where the homography folds it or leaves it tiny."""
        height, width = self._picture.grey.shape
        outline = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        depths = np.column_stack([outline, np.ones(4)]) @ frame_from_picture[2]
        corners = cv2.perspectiveTransform(outline[None], frame_from_picture)[0]
        share = np.sqrt(cv2.contourArea(corners.astype(np.float32)) / (width * height))
        if not (np.sign(depths) == np.sign(depths[0])).all() or not _LEAST_SCALE < share < 1.0 / _LEAST_SCALE:
            return None, np.zeros(0)
        # Made smaller first: warping alone would take single pixels out of a large picture.
        factor = min(1.0, float(share))
        small = cv2.resize(self._picture.grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        back = np.diag([width / small.shape[1], height / small.shape[0], 1.0])
        back[:2, 2] = 0.5 * np.diag(back)[:2] - 0.5
        warp = frame_from_picture @ back
        shown = cv2.warpPerspective(small, warp, size_px, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = cv2.warpPerspective(np.full_like(small, 255), warp, size_px, flags=cv2.INTER_NEAREST) > 0
        return (shown.astype(np.float32), seen) if seen.any() else (None, seen)
