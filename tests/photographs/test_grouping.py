"""What belongs to one stack: by folder, time, focus sweeps and camera; and which files are photographs."""

import math
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from capture.photos.focus_metadata import FocusReading
from capture.photos.photo_files import find_photos
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.sidecar import Sidecar
from capture.stacks.grouping import Grouping, Photo, PhotoGroup, by_camera, group_photos, why_aside
from mrbokeh.system.errors import InputError


def photo(name: str, seconds: float | None = None, focus_m: float | None = None, camera: str | None = "A") -> Photo:
    taken_at = None if seconds is None else datetime(2025, 1, 1) + timedelta(seconds=seconds)
    focus = None if focus_m is None else FocusReading(focus_m, focus_m, focus_m, "lens", "test")
    return Photo(Path(name), PhotoMetadata(taken_at=taken_at, focus=focus, camera_model=camera), Sidecar())


def names(photos: Sequence[Photo]) -> list[str]:
    return [each.path.name for each in photos]


def test_group_by_time_splits_at_long_pauses() -> None:
    """Shots 3 s apart with pauses of two minutes; names not in the order of time."""
    seconds = {"b": 0, "a": 3, "c": 6, "d": 126, "e": 129, "f": 250}
    groups = group_photos([("shoot", [photo(name, seconds=seconds[name]) for name in "abcdef"])], Grouping.time)
    assert [(group.name, names(group.photos)) for group in groups] == [
        ("shoot_00", ["b", "a", "c"]),
        ("shoot_01", ["d", "e"]),
        ("shoot_02", ["f"]),
    ]


def test_group_by_focus_splits_where_the_focus_turns() -> None:
    """Two sweeps near to far (the second from the start again), one back; equal distances are no turn."""
    distances_m = [0.5, 0.7, 0.7, 2.0, math.inf, 0.5, 0.7, 2.0, 1.0, 0.5]
    photos = [photo(f"{index}", focus_m=distance) for index, distance in enumerate(distances_m)]
    assert [names(group.photos) for group in group_photos([("s", photos)], Grouping.focus)] == [list("01234"), list("567"), list("89")]


def test_group_by_folder_and_none() -> None:
    folders = [("x", [photo("0")]), ("y", [photo("1")]), ("x", [photo("2")])]
    assert [group.name for group in group_photos(folders, Grouping.folder)] == ["x", "y", "x_2"]
    assert [names(group.photos) for group in group_photos(folders, Grouping.none)] == [["0", "1", "2"]]


def test_grouping_needs_what_it_goes_by() -> None:
    with pytest.raises(InputError, match="needs the time of each photograph, but b do not state it"):
        group_photos([("s", [photo("a", seconds=0), photo("b")])], Grouping.time)
    with pytest.raises(InputError, match="needs the focus distance of each photograph"):
        group_photos([("s", [photo("a"), photo("b", focus_m=1.0)])], Grouping.focus)


def test_a_camera_with_one_picture_lies_aside() -> None:
    photos = (
        photo("a.jpg"),
        photo("b.jpg"),
        photo("other.jpg", camera="B"),
        photo("fused.jpg", camera=None),
        photo("bad.dng", camera=None),
    )
    (group,) = by_camera(PhotoGroup("shoot", photos))
    assert names(group.photos) == ["a.jpg", "b.jpg", "bad.dng"]
    assert [(each.path.name, each.reason.split(",")[0]) for each in why_aside(group)] == [
        ("other.jpg", "it was taken with B"),
        ("fused.jpg", "it names no camera"),
    ]


def test_cameras_with_two_pictures_or_more_make_a_stack_each() -> None:
    cameras = {"a": "A", "b": "Model B/2", "c": "A", "d": "Model B/2", "e": "A"}
    groups = group_photos([("shoot", [photo(name, camera=camera) for name, camera in cameras.items()])], Grouping.folder)
    assert [(group.name, names(group.photos)) for group in groups] == [("shoot", ["a", "c", "e"]), ("shoot_Model_B_2", ["b", "d"])]
    assert all(
        group.remarks == ("photographs of 2 cameras, a stack for each: shoot (A, 3), shoot_Model_B_2 (Model B/2, 2)",) for group in groups
    )


def test_cameras_with_one_picture_each_make_one_stack() -> None:
    """Nothing is the usual one there, so nothing is thrown away."""
    (group,) = by_camera(PhotoGroup("shoot", tuple(photo(name, camera=name.upper()) for name in "abc")))
    assert (names(group.photos), group.aside) == (["a", "b", "c"], ())
    assert group.remarks == ("its 3 photographs name 3 cameras, none of them twice: one stack",)


def test_which_files_are_photographs(tmp_path: Path) -> None:
    for name in ("b10.jpg", "b9.jpg", "a.CR2", "a.jpg", ".hidden.jpg", "notes.txt", "depth.exr"):
        (tmp_path / name).write_text("")
    (folder,), skipped = find_photos([tmp_path], tmp_path / "scene")
    assert [path.name for path in folder.paths] == ["a.CR2", "b9.jpg", "b10.jpg"]
    assert {each.path.name for each in skipped} == {"a.jpg", "depth.exr"}
    (folder,), skipped = find_photos([tmp_path / "depth.exr", tmp_path / "notes.txt"], tmp_path / "scene")
    assert [path.name for path in folder.paths] == ["depth.exr"]
    assert [each.path.name for each in skipped] == ["notes.txt"]
    with pytest.raises(InputError, match="there is nothing at"):
        find_photos([tmp_path / "absent"], tmp_path / "scene")
