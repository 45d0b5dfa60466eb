"""Damaged photographs, other sizes, other cameras, one alone, names out of order: named, left out or remarked."""

from pathlib import Path

import numpy as np
import pytest

from capture.stacks.ingest import ingest
from mrbokeh.images.image_io import write_image
from mrbokeh.system.errors import InputError
from tests.scenes.made_photographs import make_raw_photo, make_shoot, only_stack, scene_rgb, set_exif, sources


@pytest.fixture
def shoot(tmp_path: Path) -> Path:
    return make_shoot(tmp_path / "shoot")


def test_damaged_files_are_named_and_the_rest_goes_on(shoot: Path, tmp_path: Path) -> None:
    (shoot / "IMG_13.dng").write_text("just a text\n" * 99)
    truncated = (shoot / "IMG_12.dng").read_bytes()
    (shoot / "IMG_12.dng").write_bytes(truncated[: len(truncated) // 2])
    (shoot / "IMG_14.jpg").write_bytes(b"\xff\xd8\xff\xe0 not a JPEG")
    report = ingest([shoot], tmp_path / "scene")
    stack = only_stack(report)
    assert sources(stack) == ["IMG_9.dng", "IMG_10.dng", "IMG_8.dng", "IMG_11.dng"], "and they are in order of focus all the same"
    assert [each.path for each in stack.slices] == [f"slices/{index:02d}.exr" for index in range(4)], "without a gap"
    reasons = {each.path.name: each.reason for each in report.stacks[0].skipped}
    assert set(reasons) == {"IMG_12.dng", "IMG_13.dng", "IMG_14.jpg"}
    assert "cannot be decoded as RAW" in reasons["IMG_13.dng"]
    assert {each["source"].split("/")[-1] for each in stack.metadata["skipped"]} == set(reasons)


def test_a_jpeg_beside_a_broken_raw_is_not_dropped_without_a_word(shoot: Path, tmp_path: Path) -> None:
    """Beside a good one it is what everybody expects; also when the stack was made before."""

    for name in ("IMG_9.jpg", "IMG_10.jpg"):
        write_image(shoot / name, scene_rgb(72, 96))
    (shoot / "IMG_10.dng").write_bytes((shoot / "IMG_10.dng").read_bytes()[:3000])
    for _ in range(2):
        report = ingest([shoot], tmp_path / "scene")
        reasons = {each.path.name: each.reason for each in report.skipped}
        assert reasons["IMG_9.jpg"] == "the same shot as IMG_9.dng, which is RAW"
        assert "IMG_10.dng, which is RAW but cannot be used: copy IMG_10.dng again, or move it elsewhere" in reasons["IMG_10.jpg"]
    (shoot / "IMG_10.dng").rename(tmp_path / "IMG_10.dng")
    set_exif(shoot / "IMG_10.jpg", Model="Simulated Bayer Camera")
    assert "IMG_10.jpg" in sources(only_stack(ingest([shoot], tmp_path / "scene")))


def test_nothing_usable_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "shoot").mkdir()
    with pytest.raises(InputError, match="found none"):
        ingest([tmp_path / "shoot"], tmp_path / "scene")
    (tmp_path / "shoot" / "text.dng").write_text("just a text")
    with pytest.raises(InputError, match=r"none of the 1 files .* text\.dng: it cannot be decoded"):
        ingest([tmp_path / "shoot"], tmp_path / "scene")


def test_a_picture_of_another_size_is_left_out(tmp_path: Path) -> None:
    """Also when it is the first, from which exposure was taken: then the others are evened out among themselves."""
    write_image(tmp_path / "shoot" / "0.png", np.minimum(scene_rgb(60, 64), 0.6))
    for index, factor in ((1, 1.0), (2, 0.8)):
        write_image(tmp_path / "shoot" / f"{index}.png", np.minimum(scene_rgb(48, 64), 0.6) * np.float32(factor))
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    stack = only_stack(report)
    assert sources(stack) == ["1.png", "2.png"]
    assert [each.reason for each in report.stacks[0].skipped] == ["64x60 px, but most of its stack have 64x48 px"]
    assert stack.metadata["exposure_reference"] == "1.png"
    assert [each.metadata["exposure_gain"] for each in stack.slices] == pytest.approx([1.0, 1.25], rel=0.005)
    assert len(list((stack.folder / "slices").iterdir())) == 2


def test_one_photograph_is_a_stack_that_says_what_it_lacks(tmp_path: Path) -> None:
    make_raw_photo(tmp_path / "shoot" / "0.dng", scene_rgb(24, 32), 0.6)
    report = ingest([tmp_path / "shoot"], tmp_path / "scene")
    assert len(only_stack(report)) == 1
    assert any("a stack of 1 slice: merging needs at least 2" in remark for remark in report.stacks[0].remarks)


def test_names_that_do_not_follow_the_time_are_remarked_where_focus_is_unknown(tmp_path: Path) -> None:
    """IMG_8 .. IMG_12 are in order of time, natural sorting given; renamed they are not."""
    shoot = make_shoot(tmp_path / "shoot", blur_px=1.0)
    for path in shoot.iterdir():
        set_exif(path, SubjectDistance="0/1")
    report = ingest([shoot], tmp_path / "scene")
    assert sources(only_stack(report)) == [f"IMG_{index}.dng" for index in range(8, 13)]
    assert not any("not that in which they were taken" in remark for remark in report.stacks[0].remarks)
    (shoot / "IMG_8.dng").rename(shoot / "IMG_99.dng")
    report = ingest([shoot], tmp_path / "scene")
    assert any("not that in which they were taken" in remark for remark in report.stacks[0].remarks)
