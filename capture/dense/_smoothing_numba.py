"""Tridiagonal solves of the fast global smoother along rows and columns, compiled."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def solve_rows(values: np.ndarray, links: np.ndarray, smoothness: float, first: int, end: int) -> None:
    """Rows first <= y < end of values (H, W, C) become the u of (1 + s (l_left + l_right)) u - s l_left u_left - s l_right u_right
    = value; links (H, W - 1) join a pixel with its right neighbour. Thomas's algorithm."""
    _, width, channels = values.shape
    ahead = np.empty(width)
    solved = np.empty((width, channels))
    for y in range(first, end):
        left = 0.0
        for x in range(width):
            right = smoothness * links[y, x] if x < width - 1 else 0.0
            carried = left * ahead[x - 1] if x > 0 else 0.0
            pivot = 1.0 / (1.0 + left + right - carried)
            ahead[x] = right * pivot
            for c in range(channels):
                before = left * solved[x - 1, c] if x > 0 else 0.0
                solved[x, c] = (values[y, x, c] + before) * pivot
            left = right
        for x in range(width - 2, -1, -1):
            for c in range(channels):
                solved[x, c] += ahead[x] * solved[x + 1, c]
        for x in range(width):
            for c in range(channels):
                values[y, x, c] = solved[x, c]


@njit(cache=True, nogil=True, error_model="numpy")
def solve_columns(values: np.ndarray, links: np.ndarray, smoothness: float, first: int, end: int) -> None:
    """The same along columns first <= x < end; links (H - 1, W) join a pixel with the one below."""
    height, _, channels = values.shape
    ahead = np.empty((height, end - first))
    solved = np.empty((height, end - first, channels))
    for y in range(height):
        for x in range(first, end):
            i = x - first
            above = smoothness * links[y - 1, x] if y > 0 else 0.0
            below = smoothness * links[y, x] if y < height - 1 else 0.0
            carried = above * ahead[y - 1, i] if y > 0 else 0.0
            pivot = 1.0 / (1.0 + above + below - carried)
            ahead[y, i] = below * pivot
            for c in range(channels):
                before = above * solved[y - 1, i, c] if y > 0 else 0.0
                solved[y, i, c] = (values[y, x, c] + before) * pivot
    for y in range(height - 2, -1, -1):
        for i in range(end - first):
            for c in range(channels):
                solved[y, i, c] += ahead[y, i] * solved[y + 1, i, c]
    for y in range(height):
        for x in range(first, end):
            for c in range(channels):
                values[y, x, c] = solved[y, x - first, c]
