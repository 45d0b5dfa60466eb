"""What viewers are told of a picture, whichever way it comes to them."""

from typing import Any

from viewfinder.flow.frames import OutputFrame


def finite(metres: float) -> float | None:
    """Infinity is null, for JSON has no word for it."""
    return metres if abs(metres) != float("inf") else None


def frame_header(frame: OutputFrame) -> dict[str, Any]:
    """What the page is told of a picture, ready for JSON; captured_ms is `time.monotonic`, as the clock's answers are."""
    status = frame.status
    return {
        "sequence": frame.sequence,
        "captured_ms": 1000 * frame.captured_s,
        "focus_distance_m": finite(status.focus_distance_m),
        "f_number": status.f_number,
        "focus_pending": status.focus_pending,
        "tracking": status.tracking,
        "tracking_unsure": status.tracking_unsure,
        "layer_age_ms": round(status.layer_age_ms, 1),
        "stages_ms": {name: round(took_ms, 2) for name, took_ms in status.stages_ms.items()},
        "dropped": status.dropped,
    }
