"""Photographs into focal stacks: by folder, by pauses in time, by focus sweeps, or all into one."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from statistics import median

from capture.photos.developing import is_raw
from capture.photos.photo_files import SkippedFile
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sidecar import Sidecar
from mrbokeh.system.errors import InputError

_PAUSE_TIMES_MEDIAN = 5.0
_LEAST_PAUSE_S = 20.0


class Grouping(StrEnum):
    folder = "folder"
    time = "time"
    focus = "focus"
    none = "none"


@dataclass(frozen=True)
class Photo:
    """Photograph with its shooting data, what the sidecar says already taken into account."""

    path: Path
    metadata: PhotoMetadata
    sidecar: Sidecar

    @property
    def focus_distance_m(self) -> float | None:
        return self.metadata.focus_distance_m


@dataclass(frozen=True)
class PhotoGroup:
    """Photographs of one stack, in the order of their names, and the name that the stack gets.

    aside: of other cameras; taken only where the others cannot be used. remarks: what a reader of the stack should know.
    """

    name: str
    photos: tuple[Photo, ...]
    aside: tuple[Photo, ...] = ()
    remarks: tuple[str, ...] = ()


def group_photos(folders: Sequence[tuple[str, Sequence[Photo]]], grouping: Grouping) -> list[PhotoGroup]:
    """Split (label, photographs) of each folder into stacks, one for each camera; Grouping.none puts everything into one.

    Stacks of a split folder are numbered: label_00, label_01. Photographs within a stack stay in the given order.
    """
    if grouping is Grouping.none:
        everything = tuple(photo for _, photos in folders for photo in photos)
        return [PhotoGroup(folders[0][0] if len(folders) == 1 else "stack", everything)] if everything else []
    split: Callable[[Sequence[Photo]], list[list[Photo]]] = {
        Grouping.folder: lambda photos: [list(photos)],
        Grouping.time: split_at_pauses,
        Grouping.focus: split_into_sweeps,
    }[grouping]
    groups = []
    for label, photos in folders:
        parts = split(photos)
        names = [label] if len(parts) == 1 else [f"{label}_{index:02d}" for index in range(len(parts))]
        groups += [each for name, part in zip(names, parts, strict=True) for each in by_camera(PhotoGroup(name, tuple(part)))]
    return _with_unique_names(groups)


def split_at_pauses(photos: Sequence[Photo]) -> list[list[Photo]]:
    """Begin a new stack after a pause of at least 20 s that is also five times as long as the usual one."""
    times = [photo.metadata.taken_at for photo in photos]
    unknown = [photo.path.name for photo, time in zip(photos, times, strict=True) if time is None]
    if unknown:
        names = ", ".join(unknown[:5])
        raise InputError(f"--group time needs the time of each photograph, but {names} do not state it: use --group folder")
    stamps = [time.timestamp() for time in times if time is not None]
    order = sorted(range(len(photos)), key=lambda index: stamps[index])
    ordered, stamps = [photos[index] for index in order], sorted(stamps)
    gaps_s = [after - before for before, after in pairwise(stamps)]
    pause_s = max(_LEAST_PAUSE_S, _PAUSE_TIMES_MEDIAN * median(gaps_s)) if gaps_s else 0.0
    return _cut(ordered, [gap > pause_s for gap in gaps_s])


def split_into_sweeps(photos: Sequence[Photo]) -> list[list[Photo]]:
    """Begin a new stack where the focus turns back: a sweep goes one way, near to far or far to near; standing still is no turn."""
    distances_m = [photo.focus_distance_m for photo in photos]
    unknown = [photo.path.name for photo, distance in zip(photos, distances_m, strict=True) if distance is None]
    if unknown:
        raise InputError(
            f"--group focus needs the focus distance of each photograph, but {', '.join(unknown[:5])} do not state it: "
            f"give focus_distances_m in a lens.toml, or use --group folder"
        )
    dioptres = [1.0 / distance for distance in distances_m if distance is not None]
    cuts, direction = [], 0
    for before, after in pairwise(dioptres):
        step = (after > before) - (after < before)
        turned = step * direction < 0
        cuts.append(turned)
        # The step that leads to a new sweep's first photograph says nothing about the way of that sweep.
        direction = 0 if turned else step or direction
    return _cut(photos, cuts)


def in_focus_order(photos: Sequence[Photo]) -> list[Photo]:
    """Sort nearest focus first where every distance is known, else leave the order."""
    if any(photo.focus_distance_m is None for photo in photos):
        return list(photos)
    return sorted(photos, key=lambda photo: photo.focus_distance_m or 0.0)


def by_camera(group: PhotoGroup) -> list[PhotoGroup]:
    """Make a stack for each camera that took two photographs or more, since cameras share neither lens nor exposure.

    The one that took most keeps the name of the group, and what belongs to no stack lies aside in it: single photographs of other cameras,
    and developed pictures that name no camera where most do (typically a merged result beside its sources). RAW without a name stays: it
    may be damaged, which developing will tell. Where no camera took two, all make one stack.
    """
    counted = Counter(photo.metadata.camera_model for photo in group.photos)
    usual, most = counted.most_common(1)[0]
    if usual is None or len(counted) == 1:
        return [group]
    if most == 1:
        return [
            replace(group, remarks=(f"its {len(group.photos)} photographs name {len(counted)} cameras, none of them twice: one stack",))
        ]
    repeated = [model for model, count in counted.most_common() if model and count > 1]
    names = {model: group.name if model == usual else f"{group.name}_{_as_name(model)}" for model in repeated}
    listed = ", ".join(f"{names[model]} ({model}, {counted[model]})" for model in repeated)
    remarks = (f"photographs of {len(repeated)} cameras, a stack for each: {listed}",) if len(repeated) > 1 else ()
    stacks = [
        replace(
            group, name=names[model], photos=tuple(each for each in group.photos if each.metadata.camera_model == model), remarks=remarks
        )
        for model in repeated
    ]
    rest = [each for each in group.photos if each.metadata.camera_model not in names]
    damaged = [each for each in rest if is_raw(each.path) and not each.metadata.camera_model]
    own = tuple(each for each in group.photos if each in stacks[0].photos or each in damaged)
    return [replace(stacks[0], photos=own, aside=tuple(each for each in rest if each not in damaged)), *stacks[1:]]


def why_aside(group: PhotoGroup) -> list[SkippedFile]:
    """Say of each photograph that lies aside why it does."""
    usual = next((each.metadata.camera_model for each in group.photos if each.metadata.camera_model), None)
    skipped = []
    for photo in group.aside:
        other = f"was taken with {photo.metadata.camera_model}" if photo.metadata.camera_model else "names no camera"
        skipped.append(
            SkippedFile(photo.path, f"it {other}, most of its stack with {usual} (`mrbokeh capture ingest --group none` takes it)")
        )
    return skipped


def _as_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text).strip("._") or "camera"


def _cut(photos: Sequence[Photo], cuts: Sequence[bool]) -> list[list[Photo]]:
    parts = [[photos[0]]] if photos else []
    for photo, cut in zip(photos[1:], cuts, strict=True):
        if cut:
            parts.append([])
        parts[-1].append(photo)
    return parts


def _with_unique_names(groups: list[PhotoGroup]) -> list[PhotoGroup]:
    """Number the folders of the same name in different places."""
    seen: dict[str, int] = {}
    result = []
    for group in groups:
        count = seen[group.name] = seen.get(group.name, 0) + 1
        result.append(group if count == 1 else replace(group, name=f"{group.name}_{count}"))
    return result
