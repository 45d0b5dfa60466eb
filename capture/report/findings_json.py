"""Findings of a stack as JSON: with numbers that are read back exactly, or as `report.json` shows them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from capture.report.findings import SliceFindings, StackFindings
from capture.report.focus_curve import FocusCurve
from capture.report.json_numbers import exact
from capture.report.neighbour_places import NeighbourPlace
from capture.report.picture_evidence import PictureFindings
from capture.report.slice_fit import NAMES, Change, SliceFit
from mrbokeh.stacks.focal_stack import FocalStack

Number = Callable[[float | None], float | str | None]


def slice_document(found: SliceFindings, number: Number) -> dict[str, Any]:
    changes = None if found.fit is None else {name: _change_document(change, number) for name, change in found.fit.changes.items()}
    return {
        "index": found.index,
        "gain": number(found.gain),
        "saturated_share": found.saturated,
        "counted_share": found.counted,
        "largest_coc_px": found.largest_coc_px,
        "psnr_db": number(found.psnr_db),
        "unblurred_psnr_db": number(found.unblurred_db),
        "changes": changes,
    }


def findings_document(findings: StackFindings) -> dict[str, Any]:
    """All but the stack itself."""
    curve = findings.curve
    return {
        "size_px": list(findings.size_px),
        "full_size_px": list(findings.full_size_px),
        "slices": [slice_document(each, exact) for each in findings.slices],
        "curve": vars(curve) | {"shares": curve.shares.tolist()},
        "depth_off_share": findings.depth_off_share,
        "moving_share": findings.moving_share,
        "picture": picture_document(findings.picture, exact),
        "pairs": [pair_document(each, exact) for each in findings.pairs],
    }


def findings_from(document: dict[str, Any], stack: FocalStack) -> StackFindings:
    """What `findings_document` wrote; KeyError, TypeError or ValueError where it did not."""
    curve, size_px, full_size_px = document["curve"], document["size_px"], document["full_size_px"]
    return StackFindings(
        stack,
        (int(size_px[0]), int(size_px[1])),
        (int(full_size_px[0]), int(full_size_px[1])),
        tuple(_slice_from(each) for each in document["slices"]),
        FocusCurve(**curve | {"shares": np.asarray(curve["shares"], np.float64)}),
        document["depth_off_share"],
        document["moving_share"],
        _picture_from(document["picture"]),
        tuple(_pair_from(each) for each in document["pairs"]),
    )


def picture_document(found: PictureFindings, number: Number) -> dict[str, Any]:
    return {
        "lost_share": number(found.lost),
        "flat_detail": number(found.flat),
        "largest": number(found.top),
        "largest_of_slices": number(found.slices_top),
        "seen_px": list(found.seen_px),
    }


def _picture_from(document: dict[str, Any]) -> PictureFindings:
    width, height = document["seen_px"]
    lost, flat = _number(document["lost_share"]), _number(document["flat_detail"])
    return PictureFindings(lost, flat, float(document["largest"]), float(document["largest_of_slices"]), (int(width), int(height)))


def pair_document(found: NeighbourPlace, number: Number) -> dict[str, Any]:
    return {"first": found.first, "off_px": number(found.off_px), "error_px": number(found.error_px), "place_px": list(found.place_px)}


def _pair_from(document: dict[str, Any]) -> NeighbourPlace:
    x, y = document["place_px"]
    return NeighbourPlace(int(document["first"]), _number(document["off_px"]), float(document["error_px"]), (int(x), int(y)))


def _change_document(change: Change, number: Number) -> dict[str, Any]:
    return {"value": number(change.value), "error": number(change.error)}


def _slice_from(document: dict[str, Any]) -> SliceFindings:
    changes = document["changes"]
    return SliceFindings(
        document["index"],
        float(document["gain"]),
        document["saturated_share"],
        document["counted_share"],
        document["largest_coc_px"],
        _number(document["psnr_db"]),
        _number(document["unblurred_psnr_db"]),
        None if changes is None else SliceFit(**{name: _change_from(changes[name]) for name in NAMES}),
    )


def _change_from(document: dict[str, Any]) -> Change:
    return Change(float(document["value"]), float(document["error"]))


def _number(value: float | str | None) -> float | None:
    return None if value is None else float(value)
