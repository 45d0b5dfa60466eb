"""What was found about a lens, with uncertainty, as rows for people."""

from dataclasses import dataclass

import numpy as np

from mrbokeh.lens_measuring.matching.lens_match import LensMatch


@dataclass(frozen=True)
class Row:
    """error: one standard error."""

    name: str
    value: str
    error: str = ""
    note: str = ""


def table_of(match: LensMatch) -> list[Row]:
    """Discs, opening, rim, f-number and focus."""
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
    focus = f"{sizes.focus_distance_m:.3g} m" if sizes.focus_known else "not known"
    return [
        Row("f-number", f"{sizes.f_number:.3g}", effective, scale),
        Row("focus distance", focus, "" if sizes.focus_error_m is None else f"{sizes.focus_error_m:.2g}", sizes.note),
        Row("focal length", f"{lens.focal_length_mm:g} mm", "", "as stated"),
        Row("sensor width", f"{lens.sensor_width_mm:.4g} mm", "", "as stated"),
    ]


def as_text(rows: list[Row]) -> str:
    """Columns of equal width."""
    widths = [max(len(getattr(row, name)) for row in rows) for name in ("name", "value", "error")]
    return "\n".join(
        f"{row.name:<{widths[0]}}  {row.value:>{widths[1]}} {'+-' if row.error else '  '} {row.error:<{widths[2]}}  {row.note}".rstrip()
        for row in rows
    )
