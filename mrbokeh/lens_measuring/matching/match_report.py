"""Report of a matched lens: a table with uncertainties, and a picture of its evidence.

The picture shows the discs found, the fitted outlines over them, their mean by region, and the table.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.lens_measuring.matching.lens_match import LensMatch
from mrbokeh.optics.aperture_shapes import closed


@dataclass(frozen=True)
class Row:
    """Row of the table; error: one standard error."""

    name: str
    value: str
    error: str = ""
    note: str = ""


def table_of(match: LensMatch) -> list[Row]:
    """Return rows of discs, opening, rim, f-number and focus."""
    where = "behind" if match.side > 0 else "in front of"
    full = sum(disc.full for disc in match.discs)
    rows = [
        Row("discs", str(len(match.discs)), "", f"of {len(match.found)} found, taken to lie {where} the focus; {full} of them full"),
        Row("diameter", f"{match.sizes.diameter_px:.2f} px", f"{match.sizes.diameter_error_px:.2f}", _range(match)),
    ]
    rows += _drawn(match) if match.mean is not None else _bladed(match)
    return [*rows, _rim(match), *_sizes(match)]


def _range(match: LensMatch) -> str:
    return f"of the pupil, {2.0 * match.own[:, 2].min():.1f} to {2.0 * match.own[:, 2].max():.1f} px"


def _drawn(match: LensMatch) -> list[Row]:
    misfit = float(np.median(match.choice.fit.relative_rms))
    disagreement = match.mean.disagreement if match.mean is not None else 0.0
    note = f"no opening with blades fits (off by {misfit:.1%} of the radius): the mean of the discs instead (see that these are lights)"
    return [
        Row("shape", "outline", f"{disagreement:.1%}", note),
        Row("cat-eye", "not known", "", "told apart from the outline by blades only"),
    ]


def _bladed(match: LensMatch) -> list[Row]:
    fit, opening = match.choice.fit, match.choice.fit.opening
    misfit = f"outline off by {np.median(fit.relative_rms):.1%} of the radius"
    if opening.blades:
        ranked = sorted(match.choice.log_evidence, key=lambda count: -match.choice.log_evidence[count])
        second = next(count for count in ranked if count != opening.blades)
        ahead = match.choice.log_evidence[opening.blades] - match.choice.log_evidence[second]
        against = f"log evidence {match.choice.log_evidence[opening.blades]:+.0f} against round, {ahead:+.0f} against {second}; {misfit}"
        odd = "turns by 180 degrees if the discs are on the other side of the focus" if opening.blades % 2 else ""
        turn_deg = float(np.degrees(opening.rotation_rad)) % (360.0 / opening.blades)
        rows = [
            Row("blades", str(opening.blades), "", against),
            Row("rotation", f"{turn_deg:.1f} deg", f"{np.degrees(fit.errors['rotation_rad']):.1f}", odd),
            Row("curvature", f"{opening.curvature:.2f}", f"{fit.errors['curvature']:.2f}", "0 straight, 1 round"),
        ]
    else:
        rows = [Row("blades", "round", "", f"no number of blades from 5 to 11 is told from a circle; {misfit}")]
    if "squeeze" in match.unknown:
        rows.append(
            Row("squeeze", "not known", "", "the rim that cuts the discs hides it: larger discs, and some near the middle, would tell")
        )
    else:
        rows.append(Row("squeeze", f"{opening.squeeze:.3f}", f"{fit.errors['squeeze']:.3f}", "blur so much higher than wide; 1 is none"))
    return [*rows, _cat_eye(match)]


def _cat_eye(match: LensMatch) -> Row:
    farthest = max(float(np.hypot(*disc.field_xy)) for disc in match.discs)
    if "cat_eye" in match.unknown:
        return Row(
            "cat-eye", "not known", "", f"discs reach {farthest:.2f} half diagonals from the middle: more near the corners would tell"
        )
    fit = match.choice.fit
    note = f"discs reach {farthest:.2f} half diagonals" + (
        "; negative: a rim behind the pupil, or the other --side" * (fit.opening.cat_eye < -0.05)
    )
    return Row("cat-eye", f"{fit.opening.cat_eye:.2f}", f"{fit.errors['cat_eye']:.2f}", note)


def _rim(match: LensMatch) -> Row:
    name = "spherical aberration"
    if match.rim is None:
        return Row(name, "not known", "", "too few large discs below the largest value of the file: expose less")
    value, error = match.rim
    kind = "none seen" if abs(value) <= 2.0 * error else ("bright" if value * match.side > 0 else "soft") + " rims on these discs"
    return Row(name, f"{value:+.2f}", f"{error:.2f}", kind)


def _sizes(match: LensMatch) -> list[Row]:
    sizes, lens = match.sizes, match.lens
    effective = "" if sizes.f_number_error is None else f"{sizes.f_number_error:.2f}"
    scale = (
        "as stated"
        if sizes.f_number_error is None
        else f"stated {sizes.stated_f_number:g}, scale {sizes.f_number / sizes.stated_f_number:.3f}"
    )
    focus = lens.focused_at(sizes.focus_distance_m).focus_described if sizes.focus_known else "not known"
    return [
        Row("f-number", f"{sizes.f_number:.3g}", effective, scale),
        Row("focus distance", focus, "" if sizes.focus_error_m is None else f"{sizes.focus_error_m:.2g}", sizes.note),
        Row("focal length", f"{lens.focal_length_mm:g} mm", "", "as stated"),
        Row("sensor width", f"{lens.sensor_width_mm:.4g} mm", "", "as stated"),
    ]


def as_text(rows: list[Row]) -> str:
    """Return the table with columns of equal width."""
    widths = [max(len(getattr(row, name)) for row in rows) for name in ("name", "value", "error")]
    return "\n".join(
        f"{row.name:<{widths[0]}}  {row.value:>{widths[1]}} {'+-' if row.error else '  '} {row.error:<{widths[2]}}  {row.note}".rstrip()
        for row in rows
    )


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REGIONS = (3, 3)
_CROP_PX = 64
_REACH = 1.25  # of a mean disc's picture, in pupil radii

Rgb = Float32[np.ndarray, "height width 3"]


def draw_match(rgb: Rgb, match: LensMatch) -> "Figure":
    """Draw the evidence of a match. rgb: the photograph, scene-linear."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 8.5), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.2, 1.0), height_ratios=(2.2, 1.0))
    _draw_photograph(figure.add_subplot(grid[0, 0]), rgb, match)
    _draw_regions(figure.add_subplot(grid[0, 1]), rgb, match)
    axes = figure.add_subplot(grid[1, :])
    axes.axis("off")
    axes.text(0.0, 1.0, as_text(table_of(match)), family="monospace", fontsize=9, va="top", transform=axes.transAxes)
    return figure


def _draw_photograph(axes: "Axes", rgb: Rgb, match: LensMatch) -> None:
    from mrbokeh.images.color import display_rgb8

    height, width = rgb.shape[:2]
    axes.imshow(display_rgb8(np.clip(rgb, 0.0, 1e4)), extent=(0.0, width, height, 0.0))
    kept = {id(disc) for disc in match.discs}
    for disc in match.found:
        axes.plot(*closed(disc.contour_px).T, color="lime" if id(disc) in kept else "red", lw=0.9)
    for disc, own in zip(match.discs, match.own, strict=True):
        for outline in match.lens.aperture.seen(match.side, disc.field_xy).outlines[:1]:
            axes.plot(*(own[:2] + match.side * own[2] * closed(outline)).T, color="magenta", lw=0.7, ls="--")
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_title("discs used (green), left out (red), fitted outlines (magenta)", fontsize=9)
    axes.axis("off")


def _draw_regions(axes: "Axes", rgb: Rgb, match: LensMatch) -> None:
    """Draw the mean disc of each region of the frame, scaled to one pupil radius and one brightness."""
    columns, rows = REGIONS
    height, width = rgb.shape[:2]
    sheet = np.zeros((rows * _CROP_PX, columns * _CROP_PX), np.float32)
    counts = np.zeros((rows, columns), int)
    for disc, own in zip(match.discs, match.own, strict=True):
        column, row = int(own[0] / width * columns), int(own[1] / height * rows)
        column, row = min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)
        part = (slice(row * _CROP_PX, (row + 1) * _CROP_PX), slice(column * _CROP_PX, (column + 1) * _CROP_PX))
        sheet[part] += _normalised(rgb, own, disc.level)
        counts[row, column] += 1
    sheet /= np.maximum(np.kron(counts, np.ones((_CROP_PX, _CROP_PX))), 1.0).astype(np.float32)
    axes.imshow(np.clip(sheet, 0.0, 1.5), cmap="magma")
    for row, column in np.ndindex(rows, columns):
        axes.text(column * _CROP_PX + 3, row * _CROP_PX + 9, str(counts[row, column]), color="white", fontsize=8)
    axes.set_title("mean disc by region of the frame, and of how many", fontsize=9)
    axes.axis("off")


def _normalised(rgb: Rgb, own: Float64[np.ndarray, "3"], level: float) -> Float32[np.ndarray, "crop crop"]:
    """Resample a disc about its place; OpenCV's first pixel has its centre at (0, 0)."""
    import cv2

    steps = (np.arange(_CROP_PX) + 0.5) / _CROP_PX * 2.0 - 1.0
    x, y = np.meshgrid(own[0] + _REACH * own[2] * steps - 0.5, own[1] + _REACH * own[2] * steps - 0.5)
    grey = np.ascontiguousarray(rgb.max(axis=2))
    return np.asarray(cv2.remap(grey, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR) / np.float32(level), np.float32)
