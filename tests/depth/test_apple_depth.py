"""Portrait depth of iPhones, in HEIC and behind a JPEG; files are made from Apple's properties and the standards of the containers."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from mrbokeh.compositing.open_plate import open_plate
from mrbokeh.depth.depth_map import DepthSettings
from mrbokeh.depth.open_depth import open_depth
from mrbokeh.depth.phone_depth import PhonePhoto, read_phone_photo
from mrbokeh.refocus import open_sharp
from tests.support.apple_note import apple_note
from tests.support.made_heic import Item, auxiliary, nclx, turned, write_heic
from tests.support.refusals import refused

DEPTH = "urn:mpeg:hevc:2015:auxid:2"
# The lower half of the picture is near; in the middle half a quarter of the rows is.
LEVELS = np.zeros((48, 64), np.uint8)
LEVELS[24:] = 255
GREY = np.full((96, 128, 3), 120, np.uint8)


def xmp_of(kind: str = "disparity", low: float = 1.0, high: float = 4.0, accuracy: str = "relative", f_number: str = "2.8") -> bytes:
    """The properties of an auxiliary picture."""
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        'xmlns:apdi="http://ns.apple.com/pixeldatainfo/1.0/" xmlns:depthData="http://ns.apple.com/depthData/1.0/" '
        'xmlns:depthBlurEffect="http://ns.apple.com/depthBlurEffect/1.0/">'
        "<apdi:IntMinValue>0</apdi:IntMinValue><apdi:IntMaxValue>255</apdi:IntMaxValue>"
        f"<apdi:FloatMinValue>{low}</apdi:FloatMinValue><apdi:FloatMaxValue>{high}</apdi:FloatMaxValue>"
        f"<apdi:AuxiliaryImageType>{kind}</apdi:AuxiliaryImageType><depthData:Accuracy>{accuracy}</depthData:Accuracy>"
        f"<depthBlurEffect:SimulatedAperture>{f_number}</depthBlurEffect:SimulatedAperture>"
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()


def exif_of(rendered: int = 8, orientation: int = 1, **more: object) -> bytes:
    """An iPhone's wide camera, without a focus distance. more: subject_area=(x, y, width, height), focus_m=..."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update({0x920A: IFDRational(57, 10), 0x829D: IFDRational(15, 10), 0xA405: 26, 0xA401: rendered})
    if "subject_area" in more:
        exif.get_ifd(0x8769)[0x9214] = more["subject_area"]
    if "note" in more:
        exif.get_ifd(0x8769)[0x927C] = more["note"]
    if "focus_m" in more:
        exif.get_ifd(0x8769)[0x9206] = IFDRational(int(1000 * float(str(more["focus_m"]))), 1000)
    return exif.tobytes()


def heic(path: Path, xmp: bytes, *more: bytes, rendered: int = 8, orientation: int = 1, **facts: object) -> Path:
    pytest.importorskip("pi_heif")
    depth = Item(LEVELS, (auxiliary(DEPTH), *more), xmp=xmp)
    return write_heic(path, Item(GREY, (nclx(1, 13), *more), exif=exif_of(rendered, orientation, **facts)[6:]), depth)


def jpeg(path: Path, xmp: bytes, orientation: int = 1) -> Path:
    """A JPEG with a Multi-Picture segment (CIPA DC-007), and behind it a grey one with properties of its own."""
    grey = cv2.imencode(".jpg", LEVELS, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    second = grey[:2] + segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + xmp) + grey[2:]
    plain = cv2.imencode(".jpg", GREY)[1].tobytes()
    head = plain[:2] + segment(0xE1, exif_of(orientation=orientation))

    def whole(first_bytes: int, offset: int) -> bytes:
        entries = struct.pack("<IIIHH", 0x030000, first_bytes, 0, 0, 0) + struct.pack("<IIIHH", 0, len(second), offset, 0, 0)
        tags = struct.pack("<HHI4s", 0xB000, 7, 4, b"0100") + struct.pack("<HHII", 0xB001, 4, 1, 2)
        tags += struct.pack("<HHII", 0xB002, 7, len(entries), 50)
        index = b"II*\0" + struct.pack("<IH", 8, 3) + tags + bytes(4) + entries
        return head + segment(0xE2, b"MPF\0" + index) + plain[2:]

    first_bytes = len(whole(0, 0))
    # Offsets count from the header of the index, which lies behind the marker, the length and the four letters.
    path.write_bytes(whole(first_bytes, first_bytes - len(head) - 8) + second)
    return path


def segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


def found(path: Path, near_far_m: tuple[float, float] | None = None) -> PhonePhoto:
    phone = read_phone_photo(path, near_far_m)
    assert phone is not None
    return phone


@pytest.mark.parametrize("make", [heic, jpeg])
def test_disparity_is_in_dioptres(tmp_path: Path, make: object) -> None:
    """1/m: from 1 m, which is black, to 0.25 m. Codes are whole after JPEG and HEVC but for one or two."""
    path = make(tmp_path / ("p.heic" if make is heic else "p.jpg"), xmp_of())  # type: ignore[operator]
    depth = found(path).depth
    np.testing.assert_allclose(depth.depth_m[:20], 1.0, rtol=0.03)
    np.testing.assert_allclose(depth.depth_m[28:], 0.25, rtol=0.01)
    assert "0.25 to 1 m (relative accuracy: what is nearer is known, metres are guessed" in depth.note
    stated = found(path, (0.5, np.inf)).depth
    assert stated.depth_m[40, 30] == pytest.approx(0.5, rel=0.01) and "0.5 to inf m (metres as stated)" in stated.note


def test_depth_of_absolute_accuracy_is_metres(tmp_path: Path) -> None:
    depth = found(heic(tmp_path / "p.heic", xmp_of("depth", 0.5, 3.0, "absolute"))).depth
    np.testing.assert_allclose(depth.depth_m[[10, 40]].mean(axis=1), (0.5, 3.0), rtol=0.03)
    assert "metres, as the phone measured them" in depth.note
    endless = heic(tmp_path / "q.heic", xmp_of("depth", 0.5, 3.0, "absolute"))
    refused("linear in metres, so that FAR cannot be infinite", read_phone_photo, endless, (0.5, np.inf))


def test_depth_is_turned_with_its_picture(tmp_path: Path) -> None:
    """A quarter counter-clockwise by irot brings the lower half to the right; clockwise by Exif 6, of a JPEG, to the left."""
    by_irot, by_exif = (
        found(heic(tmp_path / "p.heic", xmp_of(), turned(1))).depth.depth_m,
        found(jpeg(tmp_path / "p.jpg", xmp_of(), 6)).depth.depth_m,
    )
    assert by_irot.shape == by_exif.shape == (64, 48)
    assert by_irot[:, 30:].max() < 0.3 < 0.9 < by_irot[:, :18].min()
    assert by_exif[:, :18].max() < 0.3 < 0.9 < by_exif[:, 30:].min()


def test_a_portrait_tells_its_blur_and_its_focus_is_guessed(tmp_path: Path) -> None:
    """26 mm at f/2.8 on full frame is an opening of 9.286 mm; 128x96 px have a diagonal of 160, so that the focal length is 26/43.27 of
    that: 0.892 px for each dioptre from the focus.
    """
    focus = found(heic(tmp_path / "p.heic", xmp_of())).focus
    assert focus is not None and focus.focus_distance_m == pytest.approx(0.25, rel=0.02)
    assert focus.coc_px_per_dioptre(128, 96) == pytest.approx(26 / 2800 * 26 / 43.2666 * 160, rel=1e-3)
    assert "focus is guessed" in focus.note and "full frame at f/2.8" in focus.blur_note
    plain = found(heic(tmp_path / "q.heic", xmp_of(), rendered=0)).focus
    assert plain is not None and plain.blur_at_infinity is None and not plain.blur_note


def test_the_subject_area_is_turned_with_a_picture_held_upside_down(tmp_path: Path) -> None:
    """Exif counts it in the picture as stored, whose upper middle, 1 m away, comes to lie in the lower middle."""
    area = {"subject_area": (64, 12, 20, 20)}
    assert found(heic(tmp_path / "p.heic", xmp_of(), **area)).focus.focus_distance_m == pytest.approx(1.0, rel=0.03)
    for quarters, orientation in ((2, 3), (1, 8), (3, 6)):
        path = heic(tmp_path / f"{orientation}.heic", xmp_of(), turned(quarters), orientation=orientation, **area)
        assert found(path).focus.focus_distance_m == pytest.approx(1.0, rel=0.03), "which irot turns"
    upright_area = {"subject_area": (64, 84, 20, 20)}
    assert found(heic(tmp_path / "u.heic", xmp_of(), turned(2), orientation=3, **upright_area)).focus.focus_distance_m < 0.3


def test_a_focus_that_exif_states_is_not_called_guessed(tmp_path: Path) -> None:
    plate = open_plate(heic(tmp_path / "p.heic", xmp_of(), focus_m=0.5))
    assert plate.lens.focus_distance_m == pytest.approx(0.5, rel=0.02)
    assert "focus is guessed" not in plate.depth_note and "full frame at f/2.8" in plate.depth_note


def test_the_range_of_the_focus_gives_a_relative_depth_its_metres(tmp_path: Path) -> None:
    """2 / (1 / 0.8 + 1 / 1.6) = 1.067 m, where the depth has 0.25: all metres grow by that, and the blur in pixels stays."""
    plain, told = (found(heic(tmp_path / f"{len(note)}.heic", xmp_of(), **({"note": note} if note else {}))) for note in (b"", FOCUSED))
    assert plain.focus is not None and told.focus is not None
    stated_m = 2.0 / (1.0 / 0.8 + 1.0 / 1.6)
    assert told.focus.focus_distance_m == pytest.approx(stated_m) and not told.focus.note and "as the file tells" in told.depth.note
    np.testing.assert_allclose(told.depth.depth_m, plain.depth.depth_m * stated_m / plain.focus.focus_distance_m, rtol=1e-5)
    assert told.focus.blur_at_infinity == plain.focus.blur_at_infinity
    absolute = found(heic(tmp_path / "a.heic", xmp_of(accuracy="absolute"), note=FOCUSED))
    np.testing.assert_array_equal(absolute.depth.depth_m, plain.depth.depth_m)
    assert open_plate(tmp_path / f"{len(FOCUSED)}.heic").lens.focus_distance_m == pytest.approx(stated_m, rel=0.02)


FOCUSED = apple_note({12: [(8, 10), (16, 10)]})


def test_composite_takes_depth_lens_and_blur_from_the_file(tmp_path: Path) -> None:
    path = heic(tmp_path / "p.heic", xmp_of())
    plate = open_plate(path)
    assert plate.depth_m is not None and plate.depth_m.shape == (96, 128) and plate.sharp_rgb is None
    assert plate.blur_from == "the phone's own blur" and "focus is guessed" in plate.depth_note
    assert plate.lens.coc_px_per_dioptre(128) == pytest.approx(26 / 2800 * 26 / 43.2666 * 160, rel=0.01)
    told = open_plate(path, focus_m=0.5)
    assert told.lens.focus_distance_m == 0.5 and "guessed from" not in told.depth_note
    sharp = open_plate(heic(tmp_path / "q.heic", xmp_of(), rendered=0))
    assert not sharp.blur_from and (sharp.lens.focal_length_mm, sharp.lens.f_number) == (5.7, 1.5), "the lens of its Exif"
    wider = open_plate(path, facts={"f_number": 1.4})
    assert wider.lens.coc_px_per_dioptre(128) == pytest.approx(2.0 * plate.lens.coc_px_per_dioptre(128)), "the file says f/2.8"
    assert "full frame at f/1.4" in wider.blur_from and "f/2.8" not in wider.depth_note
    assert open_plate(path, facts={"f_number": 1.8, "focal_length_mm": 5.7}).lens.f_number == 1.8
    assert open_sharp(path, None, DepthSettings()).focus_m == pytest.approx(0.25, rel=0.02)
    assert open_depth(path, plate.rgb, DepthSettings(near_far_m=(1.0, 2.0))).depth_m.min() == pytest.approx(1.0, rel=0.02)


def test_other_auxiliary_pictures_are_no_depth(tmp_path: Path) -> None:
    """A gain map lies beside the picture, and changes neither it nor its depth."""
    pytest.importorskip("pi_heif")
    gain = Item(np.full((48, 64), 200, np.uint8), (auxiliary("urn:com:apple:photo:2020:aux:hdrgainmap"),))
    path = write_heic(tmp_path / "p.heic", Item(GREY, (nclx(1, 13),), exif=exif_of()[6:]), gain)
    plain = write_heic(tmp_path / "q.heic", Item(GREY, (nclx(1, 13),), exif=exif_of()[6:]))
    assert read_phone_photo(path) is None
    np.testing.assert_array_equal(open_plate(path, focus_m=1.0).rgb, open_plate(plain, focus_m=1.0).rgb)
    assert read_phone_photo(jpeg(tmp_path / "p.jpg", xmp_of("portraiteffectsmatte"))) is None
    refused("does not tell its lens .unknown: focus distance", open_plate, plain)


def test_what_is_missing_or_damaged_is_one_sentence(tmp_path: Path) -> None:
    refused("does not say what its numbers mean: state it with --disparity", read_phone_photo, heic(tmp_path / "a.heic", b""))
    refused("from 4 to 1, which is no range", read_phone_photo, heic(tmp_path / "b.heic", xmp_of(low=4.0, high=1.0)))
    refused("from nan to 1", read_phone_photo, jpeg(tmp_path / "c.jpg", xmp_of(low=float("nan"), high=1.0)))
    assert found(heic(tmp_path / "a.heic", b""), (0.5, 2.0)).depth.depth_m.min() == pytest.approx(0.5, rel=0.01)
    whole = jpeg(tmp_path / "d.jpg", xmp_of()).read_bytes()
    place = whole.index(b"MPF\0")
    (tmp_path / "d.jpg").write_bytes(whole[: place + 6] + b"\xff" * 20 + whole[place + 26 :])
    assert read_phone_photo(tmp_path / "d.jpg") is None, "an index that leads nowhere"
