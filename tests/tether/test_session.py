"""One white balance and one exposure scale for all stacks of a scene, also over several calls."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from capture.photos.raw import camera_white_balance
from capture.stacks.grouping import Grouping
from capture.stacks.ingest import IngestReport, IngestSettings, ingest
from capture.stacks.session import read_session
from capture.stacks.stack_ingest import Development
from mrbokeh.images.image_io import write_image
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError
from tests.support.made_photographs import defocused, make_raw_photo, make_shoot, only_stack, scene_rgb, set_exif, set_neutral, sources


@pytest.fixture
def shoot(tmp_path: Path) -> Path:
    return make_shoot(tmp_path / "shoot")


def test_one_white_balance_for_the_stack(shoot: Path, tmp_path: Path) -> None:
    """The camera chose another one for the second file: the first file's holds for both, so that equal light stays equal."""
    set_neutral(shoot / "IMG_9.dng", 0.9, 0.5)
    assert camera_white_balance(shoot / "IMG_9.dng") == pytest.approx((1 / 0.9, 1.0, 2.0), rel=1e-3)
    stack = only_stack(ingest([shoot], tmp_path / "scene"))
    assert sources(stack)[0] == "IMG_9.dng"
    assert all(each.metadata["white_balance"] == stack.slices[1].metadata["white_balance"] for each in stack.slices)
    assert np.array_equal(stack.slice_rgb(0), stack.slice_rgb(1))
    given = IngestSettings(development=Development(white_balance=(1.5, 1.0, 1.2)))
    assert only_stack(ingest([shoot], tmp_path / "given", given)).slices[0].metadata["white_balance"] == [1.5, 1.0, 1.2]


def make_views(folder: Path, **exposures: tuple[Fraction, ...]) -> Path:
    """A folder of DNGs for each view, all of one scene, with the exposure times given."""
    rgb = gaussian_filter(np.minimum(scene_rgb(72, 96), 0.5), (1, 1, 0))
    for view, times_s in exposures.items():
        for index, time_s in enumerate(times_s):
            make_raw_photo(folder / view / f"{index}.dng", rgb, 0.6 + 0.2 * index, time_s)
    return folder


def stacks_by_name(report: IngestReport) -> dict[str, FocalStack]:
    return {each.name: each.stack for each in report.stacks if each.stack is not None}


def test_all_stacks_of_a_scene_share_one_exposure_scale(tmp_path: Path) -> None:
    """view_1 got a quarter of the light, and within it the second slice half of that: all come out equally bright."""
    sixtieth = Fraction(1, 60)
    shoot = make_views(tmp_path / "shoot", view_0=(sixtieth, sixtieth), view_1=(sixtieth / 4, sixtieth / 8))
    stacks = stacks_by_name(ingest([shoot], tmp_path / "scene"))
    gains = {name: [each.metadata["exposure_gain"] for each in stack.slices] for name, stack in stacks.items()}
    assert gains["view_0"] == [1.0, 1.0] and gains["view_1"] == pytest.approx([4.0, 8.0])
    assert stacks["view_1"].slices[1].metadata["exposure_gain_session"] == pytest.approx(4.0)
    assert stacks["view_1"].slices[1].metadata["saturation_level"] == pytest.approx(8.0)
    means = [stack.slice_rgb(index).mean(axis=(0, 1)) for stack in stacks.values() for index in range(2)]
    for mean in means[1:]:
        assert mean == pytest.approx(means[0], rel=0.004)


def test_later_calls_reuse_the_choice_of_the_first(tmp_path: Path) -> None:
    """view_1 comes later, half as long exposed and with another white balance of the camera's."""
    shoot = make_views(tmp_path / "shoot", view_0=(Fraction(1, 60),) * 2, view_1=(Fraction(1, 120),) * 2)
    for index in range(2):
        set_neutral(shoot / "view_1" / f"{index}.dng", 0.9, 0.5)
    at_once = stacks_by_name(ingest([shoot], tmp_path / "at_once"))
    ingest([shoot / "view_0"], tmp_path / "scene")
    later = stacks_by_name(ingest([shoot / "view_1"], tmp_path / "scene"))["view_1"]
    assert later.metadata["white_balance"] == pytest.approx([2.0, 1.0, 1.6], abs=1e-3)
    assert later.slices[0].metadata["exposure_gain"] == pytest.approx(2.0)
    assert np.array_equal(later.slice_camera_rgb(1), at_once["view_1"].slice_camera_rgb(1))
    assert later.rec709_from_camera == at_once["view_0"].rec709_from_camera
    # Made again alone, it still belongs to view_0.
    again = stacks_by_name(ingest([shoot / "view_1"], tmp_path / "scene", IngestSettings(overwrite=True)))["view_1"]
    assert np.array_equal(again.slice_camera_rgb(1), later.slice_camera_rgb(1))


def test_another_white_balance_is_refused_unless_all_is_made_again(tmp_path: Path) -> None:
    shoot = make_views(tmp_path / "shoot", view_0=(Fraction(1, 60),) * 2, view_1=(Fraction(1, 60),) * 2)
    ingest([shoot], tmp_path / "scene")
    warmer = Development(white_balance=(2.2, 1.0, 1.5))
    for given, overwrite in ((shoot, False), (shoot / "view_1", True)):
        with pytest.raises(InputError, match=r"share the white balance 2,1,1\.6 \(from 0\.dng\), but 2\.2,1,1\.5 was asked for"):
            ingest([given], tmp_path / "scene", IngestSettings(development=warmer, overwrite=overwrite))
    same = IngestSettings(development=Development(white_balance=(2.0, 1.0, 1.6)))
    assert [each.kept for each in ingest([shoot], tmp_path / "scene", same).stacks] == [2, 2], "the same one in numbers is no other"
    stacks = stacks_by_name(ingest([shoot], tmp_path / "scene", IngestSettings(development=warmer, overwrite=True)))
    assert all(stack.metadata["white_balance"] == [2.2, 1.0, 1.5] for stack in stacks.values())


def test_each_camera_of_a_scene_has_its_own_choice(tmp_path: Path) -> None:
    shoot = make_views(tmp_path / "shoot", a=(Fraction(1, 60),) * 2, b=(Fraction(1, 30),) * 2)
    for index in range(2):
        set_exif(shoot / "b" / f"{index}.dng", Model="Another Camera")
        set_neutral(shoot / "b" / f"{index}.dng", 0.25, 0.5)
    stacks = stacks_by_name(ingest([shoot], tmp_path / "scene"))
    assert stacks["b"].metadata["white_balance"] == pytest.approx([4.0, 1.0, 2.0], abs=1e-3)
    assert [each.metadata["exposure_gain"] for each in stacks["b"].slices] == [1.0, 1.0], "sensitivities of two cameras differ anyway"
    assert set(read_session(tmp_path / "scene").cameras) == {"Simulated Bayer Camera", "Another Camera"}


def test_developed_pictures_join_a_raw_stack_in_its_primaries(tmp_path: Path) -> None:
    """--group none: a PNG of the same light beside two RAW files; in Rec.709 all agree."""
    rgb = gaussian_filter(np.minimum(scene_rgb(72, 96), 0.5), (1, 1, 0))
    for index in range(2):
        make_raw_photo(tmp_path / "shoot" / f"{index}.dng", rgb, 0.6)
    write_image(tmp_path / "shoot" / "2.png", rgb)
    stack = only_stack(ingest([tmp_path / "shoot"], tmp_path / "scene", IngestSettings(grouping=Grouping.none)))
    assert np.abs(stack.slice_rgb(2) - rgb).max() < 2e-5 and np.abs(stack.slice_camera_rgb(2) - rgb).max() > 0.01


def test_overlap_tells_what_metadata_do_not(tmp_path: Path) -> None:
    """PNG without metadata: view_b shows the same at 0.7 of the light and is brought up, view_c something else and is left alone."""
    rgb = np.minimum(scene_rgb(96, 128), 0.6)
    for view, picture in (("a", rgb), ("b", rgb * np.float32(0.7)), ("c", np.minimum(scene_rgb(96, 128, 5), 0.6))):
        for index in range(2):
            write_image(tmp_path / "shoot" / view / f"{index}.png", defocused(picture, index))
    reports = {each.name: each for each in ingest([tmp_path / "shoot"], tmp_path / "scene").stacks}
    stacks = {name: report.stack for name, report in reports.items() if report.stack is not None}
    gains = {name: [each.metadata["exposure_gain"] for each in stack.slices] for name, stack in stacks.items()}
    assert gains["a"] == gains["c"] == [1.0, 1.0] and gains["b"] == pytest.approx([1 / 0.7] * 2, rel=0.005)
    assert not any("does not state its exposure" in remark for remark in reports["a"].remarks)
    assert any("compared with a the gain is 1.43" in remark for remark in reports["b"].remarks)
    assert any("may be on another scale than that of a" in remark for remark in reports["c"].remarks)


def test_numbers_of_exr_are_light_already(tmp_path: Path) -> None:
    rgb = np.minimum(scene_rgb(48, 64), 0.6)
    for view, factor in (("a", 1.0), ("b", 0.7)):
        write_image(tmp_path / "shoot" / view / "0.exr", rgb * np.float32(factor))
    stacks = stacks_by_name(ingest([tmp_path / "shoot"], tmp_path / "scene"))
    assert stacks["b"].slices[0].metadata["exposure_gain"] == 1.0


def test_lenses_without_contacts_share_a_scale_too(tmp_path: Path) -> None:
    """No f-number in any file: the aperture ring stays where it is, exposure times tell the rest."""
    shoot = make_views(tmp_path / "shoot", a=(Fraction(1, 60),) * 2, b=(Fraction(1, 30),) * 2)
    for path in shoot.rglob("*.dng"):
        set_exif(path, FNumber="")
    stacks = stacks_by_name(ingest([shoot], tmp_path / "scene"))
    assert [each.metadata["exposure_gain"] for each in stacks["b"].slices] == pytest.approx([0.5, 0.5])


def test_sessions_of_other_versions_are_refused(tmp_path: Path) -> None:
    (tmp_path / "session.json").write_text('{"format": "mrbokeh-capture-session", "version": 99}')
    with pytest.raises(InputError, match="version 99: delete it and ingest"):
        read_session(tmp_path)
