"""What a user types becomes a Finishing; every option does something, and mistakes are told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.commands.composite import matched_told
from mrbokeh.compositing.plate_look.finishing import Finishing, LightWrap, LookOptions, finishing_of
from mrbokeh.compositing.plate_look.grain import measured_grain, write_grain
from mrbokeh.compositing.plate_look.vignetting import CameraAndLens, FlatField, RadialFalloff, lensfun_falloff
from mrbokeh.images.image_io import write_image
from tests.compositing.test_plate_look_grain import plate, smooth_scene
from tests.support.refusals import refused

LENS_MODEL = "Canon EF 100mm f/2.8L Macro IS USM"


@pytest.fixture(scope="module")
def frames() -> tuple[np.ndarray, np.ndarray]:
    return plate(smooth_scene(), 1, 0.6), plate(smooth_scene(), 2, 0.6)


def photo_with_exif(path: Path, exposure_time_s: float = 0.01, lens_model: str = LENS_MODEL) -> Path:
    from PIL import Image

    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Canon", "Canon EOS 450D"
    exif[0x8769] = {0x829A: exposure_time_s, 0x829D: 2.8, 0x8827: 200, 0x920A: 100.0, 0xA434: lens_model}
    Image.new("RGB", (48, 32), (90, 90, 90)).save(path, exif=exif)
    return path


def test_nothing_typed_does_nothing_and_grey_black_and_value_what_they_say(frames: tuple[np.ndarray, np.ndarray]) -> None:
    assert finishing_of(LookOptions(), frames[0]) == Finishing()
    assert finishing_of(LookOptions(match_black="off", vignetting="off", grain="off", light_wrap="off"), frames[0]) == Finishing()
    # At (100, 100) the scene is smooth_scene()[100, 100]; the card's value divides, the black is taken off first.
    level = smooth_scene()[100, 100]
    found = finishing_of(LookOptions(match_grey="100,100,4"), frames[0]).colour
    assert found is not None
    np.testing.assert_allclose(found.gain, level / 0.18, rtol=0.05)
    halved = finishing_of(LookOptions(match_grey="100,100,4", grey_value=0.36), frames[0]).colour
    assert halved is not None
    np.testing.assert_allclose(halved.gain, np.array(found.gain) / 2)
    with_hole = frames[0].copy()
    with_hole[90:110, :20] = (0.02, 0.01, 0.015)
    for text in ("10,100,2", "auto"):
        lifted = finishing_of(LookOptions(match_grey="100,100,4", match_black=text), with_hole).colour
        assert lifted is not None and lifted.black == pytest.approx((0.02, 0.01, 0.015), rel=1e-5)
        np.testing.assert_allclose(lifted.gain, (np.array(found.gain) * 0.18 - lifted.black) / 0.18)
    plain = finishing_of(LookOptions(match_grey="10,10,4"), frames[0]).colour
    found = finishing_of(LookOptions(match_grey="10,10,4", vignetting="-0.5"), frames[0])
    assert plain is not None and found.colour is not None and found.vignetting == RadialFalloff(-0.5)
    assert found.colour.gain[0] / plain.gain[0] == pytest.approx(1 / (1 - 0.5 * 0.9), abs=0.08)


def test_exposure_and_white_of_the_metadata(tmp_path: Path, frames: tuple[np.ndarray, np.ndarray]) -> None:
    photo, panorama = photo_with_exif(tmp_path / "plate.jpg", 0.04), photo_with_exif(tmp_path / "panorama.jpg", 0.01)
    options = LookOptions(match_exposure=panorama)
    found = finishing_of(options, frames[0], photo).colour
    assert found is not None and found.gain == pytest.approx((4.0, 4.0, 4.0))
    warm = finishing_of(replace(options, match_white_k=2856.0), frames[0], photo).colour
    assert warm is not None and warm.gain[0] < 2.0 and warm.gain[1] == pytest.approx(4.0) and warm.gain[2] > 8.0


def test_grain_of_the_plate_of_a_file_and_of_two_frames(tmp_path: Path, frames: tuple[np.ndarray, np.ndarray]) -> None:
    alone = finishing_of(LookOptions(grain="auto", seed=3), frames[0]).grain
    pair = finishing_of(LookOptions(grain="auto"), frames[0], next_rgb=frames[1]).grain
    copied = finishing_of(LookOptions(grain="auto"), frames[0], next_rgb=frames[0]).grain
    assert alone is not None and pair is not None and copied is not None
    assert alone.seed == 3 and alone.level == measured_grain(frames[0]).level == copied.level != pair.level
    write_grain(tmp_path / "grain.json", alone)
    found = finishing_of(LookOptions(grain=str(tmp_path / "grain.json"), seed=9), frames[0]).grain
    assert found is not None and found.level == alone.level and found.seed == 9


def test_vignetting_by_coefficients_flat_field_and_lensfun_and_light_wrap(frames: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    assert finishing_of(LookOptions(light_wrap="0.3"), frames[0]).light_wrap == LightWrap(0.3)
    assert finishing_of(LookOptions(light_wrap="0.3,5"), frames[0]).light_wrap == LightWrap(0.3, 5.0)
    write_image(tmp_path / "flat.exr", np.full((32, 48, 3), 0.5, np.float32))
    assert isinstance(finishing_of(LookOptions(vignetting=str(tmp_path / "flat.exr")), frames[0]).vignetting, FlatField)
    pytest.importorskip("lensfunpy")
    found = finishing_of(LookOptions(vignetting="auto"), frames[0], photo_with_exif(tmp_path / "plate.jpg")).vignetting
    assert found == lensfun_falloff(CameraAndLens("Canon", "Canon EOS 450D", LENS_MODEL), 100.0, 2.8)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (LookOptions(match_grey="1,1,1", match_white_k=5000.0), "--match-grey sets exposure and white balance"),
        (LookOptions(match_exposure=Path("x.jpg")), "--match-exposure needs a photograph"),
        (LookOptions(match_black="dark"), "--match-black: expected X,Y"),
        (LookOptions(vignetting="auto"), "--vignetting auto needs a photograph"),
        (LookOptions(vignetting="strong"), "--vignetting: expected K1,K2,K3"),
        (LookOptions(grain="none.json"), "expected a grain file at none.json"),
        (LookOptions(light_wrap="much"), "--light-wrap: expected STRENGTH"),
        (LookOptions(match_white_k=100.0), "colour temperature of 2000 to 25000"),
    ],
)
def test_mistakes_are_told(options: LookOptions, message: str, frames: tuple[np.ndarray, np.ndarray]) -> None:
    refused(message, finishing_of, options, frames[0])


def test_photographs_that_name_no_lens_are_refused(tmp_path: Path, frames: tuple[np.ndarray, np.ndarray], shared_data: Path) -> None:
    options = LookOptions(vignetting="auto")
    refused("name camera and lens", finishing_of, options, frames[0], shared_data / "exif" / "canon_450d_4.6m.jpg")
    (tmp_path / "text.jpg").write_text("no picture")
    refused("expected a photograph with Exif", finishing_of, options, frames[0], tmp_path / "text.jpg")


@pytest.mark.parametrize(("wanted", "matched", "told"), [
    ({}, ["--match-black", "--grain"], "the object gets the black, grain and compression of the photograph"),
    ({}, ["--grain"], "(to leave out: --grain off); no black could be measured in the photograph, so none is put on it"),
    ({"grain": "off"}, ["--match-black"], "the object gets the black of the photograph (to leave out: --match-black off)"),
    ({"match_black": "off"}, [], "no grain or compression could be measured in the photograph, so none is put on it"),
])  # fmt: skip
def test_what_an_object_gets_of_the_photograph_unasked_is_told(wanted: dict[str, str], matched: list[str], told: str) -> None:
    said = matched_told(LookOptions(**wanted), matched)  # type: ignore[arg-type]
    assert told in said and ("could be measured" in said) == ("could be measured" in told)
