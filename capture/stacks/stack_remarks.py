"""What a reader of a stack should know: its scale, what its lens lacks, what to check before merging."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from capture.stacks.grouping import Photo
from capture.stacks.session import GIVEN
from capture.stacks.stack_ingest import StackWork
from capture.stacks.stack_lens import lens_remarks
from mrbokeh.optics.lens import Lens

FEWEST_TO_MERGE = 2


def stack_remarks(work: StackWork, reference: Photo, lens: Lens | None, missing: str | None) -> list[str]:
    """Say in sentences what a reader should know. missing: why there is no lens."""
    photos = [each.photo for each in work.finished]
    counted = Counter(remark for each in work.finished for remark in each.record["remarks"])
    remarks = [remark if count == 1 or count == len(photos) else f"{remark} ({count} slices)" for remark, count in counted.items()]
    remarks = [*work.remarks, *remarks, *_session_remarks(work)]
    if any((photo.metadata.orientation or 1) != 1 for photo in photos):
        remarks.append("EXIF asks to turn pictures of this stack: they are left as the sensor saw them, and turned for people to look at")
    remarks += _sidecar_remarks(photos)
    if lens is None:
        remarks.append(f"no lens: {missing}. Give what is missing in a lens.toml beside the photographs and ingest again")
    elif reference.sidecar.sensor_width_mm is None and (sensor := reference.metadata.sensor) is not None:
        remarks.append(f"sensor width {lens.sensor_width_mm:.4g} mm from {sensor.source}")
    return remarks + lens_remarks(photos) + _order_remarks(photos)


def _order_remarks(photos: Sequence[Photo]) -> list[str]:
    """What a reader should check before merging."""
    remarks = []
    if len(photos) < FEWEST_TO_MERGE:
        remarks.append(f"a stack of {len(photos)} slice{'s' if len(photos) > 1 else ''}: merging needs at least {FEWEST_TO_MERGE}")
    times = [photo.metadata.taken_at for photo in photos]
    known = [time for time in times if time is not None]
    if len(known) == len(times) and known != sorted(known) and any(photo.focus_distance_m is None for photo in photos):
        remarks.append(
            "slices are in the order of the file names, which is not that in which they were taken: merging sorts them by their focus "
            "where pictures tell it"
        )
    return remarks


def _session_remarks(work: StackWork) -> list[str]:
    """Which scale the stack shares with the others of its scene, and where it does not."""
    remarks, choice, reference = [], work.choice, work.finished[0]
    if choice.white_balance is not None:
        multipliers = ",".join(f"{each:.4g}" for each in choice.white_balance)
        whose = "the one given" if choice.white_balance_source == GIVEN else f"the camera's of {choice.white_balance_source}"
        remarks.append(f"one white balance for all RAW of the scene: {whose}. For the same in other scenes: --white-balance {multipliers}")
    metadata, name = reference.record["metadata"], reference.photo.path.name
    if metadata["exposure_gain_session_from"] == "overlap":
        gain = metadata["exposure_gain_session"]
        remarks.append(f"{name} does not state its exposure: compared with {choice.reference_stack} the gain is {gain:.3g}")
    elif metadata["exposure_gain_session_from"] == "nothing" and work.folder.name != choice.reference_stack:
        remarks.append(f"{name} does not state its exposure: its radiance may be on another scale than that of {choice.reference_stack}")
    return remarks


def _sidecar_remarks(photos: Sequence[Photo]) -> list[str]:
    sidecar = photos[0].sidecar
    files = list(dict.fromkeys(Path(each).name for each in (sidecar.where, sidecar.focus_where) if each))
    if not files:
        return []
    unmatched = sidecar.unmatched_names([photo.path.name for photo in photos])
    note = f"; it names files that are not in this stack: {', '.join(unmatched)}" if unmatched else ""
    return [f"{' and '.join(files)} {'was' if len(files) == 1 else 'were'} read{note}"]
