"""The examples of docs/examples.md with pictures: every command has one, each picture is there, and the gallery is made by running them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_scripts.gallery.__main__ import Entry, build, read_entries
from datasets_scripts.gallery.pictures import WIDEST_PX, result_jpeg
from mrbokeh.cli import SUB_COMMANDS
from mrbokeh.images.image_io import write_image, write_layer
from mrbokeh.images.layer import Layer
from tests.support.refusals import refused

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples.md"
ENTRIES = read_entries(EXAMPLES.read_text(encoding="utf-8"))
WITHOUT_PICTURE = {
    "doctor",  # it prints a table of what is installed here
    "serve",  # it goes on until Ctrl-C; the page shows what Blender made of it,
    "host",  # which the gallery cannot make
}


def decoded(jpeg: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def test_every_command_has_an_example_with_a_picture() -> None:
    shown = {line.split()[1] for entry in ENTRIES for line in entry.commands if line.startswith("mrbokeh ")}
    assert set(SUB_COMMANDS) - shown <= WITHOUT_PICTURE


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.picture.stem)
def test_the_picture_is_there(entry: Entry) -> None:
    picture = decoded((EXAMPLES.parent / entry.picture).read_bytes())
    assert picture.shape[1] <= WIDEST_PX and picture.std() > 5.0, "a picture of something"
    assert (EXAMPLES.parent / entry.picture).stat().st_size < 300_000


def test_examples_are_read_from_headings_blocks_and_comments() -> None:
    page = (
        "# Use\n## `mrbokeh refocus`: new slices\n\nText.\n\n```sh\nmrbokeh refocus a \\\n    --out b   # new\npython -m x\n```\n\n"
        "![Three slices](docs/pictures/refocus.jpg)\n<!-- shows: b/sheet.png -->\n## no picture\n```sh\nmrbokeh doctor\n```\n"
    )
    (entry,) = read_entries(page)
    assert entry.title == "mrbokeh refocus: new slices" and entry.caption == "Three slices"
    assert [line.split() for line in entry.commands] == [["mrbokeh", "refocus", "a", "--out", "b"], ["python", "-m", "x"]]
    assert (entry.picture, entry.shows, entry.page) == (Path("docs/pictures/refocus.jpg"), "b/sheet.png", "")
    refused("found none", read_entries, "nothing")


@pytest.mark.slow
def test_the_gallery_is_made_by_the_commands_and_what_a_check_finds_is_its_result(tmp_path: Path) -> None:
    """One changed pixel of 16 x 24: `check` ends with 1 and writes the map. The demo is not run again, for it is finished."""
    demo, out, plate = tmp_path / "demo", tmp_path / "out", np.full((16, 24, 3), 0.2, np.float32)
    demo.mkdir()
    out.mkdir()
    refused("expected a finished demo", build, out, ENTRIES[:1], demo)
    (demo / "report.html").write_text("done")
    write_image(out / "plate.png", plate)
    plate[4, 5] = 0.9
    write_image(out / "out.png", plate)
    write_layer(out / "layer.exr", Layer(plate * 0.0, plate[..., 0] * 0.0, np.full((16, 24), np.inf, np.float32)))
    new = "mrbokeh lens new lens.json --focal-length 50 --f-number 2 --focus 1"
    commands = ("mrbokeh demo --out demo_out", new, "mrbokeh check out.png --against plate.png --virtual layer.exr --leaks leaks.png")
    made = Entry(title="check", commands=commands, caption="A", picture=Path("docs/pictures/a.jpg"), shows="out.png leaks.png")
    build(out, [made], demo)
    assert decoded((out / "a.jpg").read_bytes()).shape == (16, 48, 3)
    assert "mrbokeh check" in (out / "gallery.html").read_text()
    (out / "a.jpg").unlink()
    build(out, [made], demo)  # would be refused if `lens new` ran again
    assert (out / "a.jpg").is_file() and (out / "repository" / "README.md").is_file() and (out / "demo_out" / "report.html").is_file()
    assert [each.name for each in demo.iterdir()] == ["report.html"]
    broken = Entry(title="b", commands=("mrbokeh lens show none.json --out b.png",), caption="", picture=Path("b.jpg"), shows="b.png")
    refused(r"(?s)ended with 2.*none\.json", build, out, [broken], demo)
    quick = Entry(title="q", commands=("mrbokeh demo --quick --no-such-option",), caption="", picture=Path("q.jpg"), shows="q.png")
    refused("ended with 2", build, out, [quick], demo)  # it was run: only the whole demo is done already


def test_pictures_stand_side_by_side_long_sheets_are_cut_and_linear_ones_shown_as_light(tmp_path: Path) -> None:
    """Both 20 px high, the larger at half its size; of a sheet as high as wide 0.9 of the height are shown."""
    for name, height, width in (("small.png", 20, 30), ("large.png", 40, 100), ("sheet.png", 200, 200)):
        write_image(tmp_path / name, np.full((height, width, 3), 0.3, np.float32))
    assert decoded(result_jpeg(tmp_path / "small.png", tmp_path / "large.png")).shape == (20, 80, 3)
    assert decoded(result_jpeg(tmp_path / "sheet.png")).shape == (180, 200, 3)
    # Linear 0.2140 is half of sRGB's range, 128 of 255.
    write_image(tmp_path / "grey.exr", np.full((40, 2000, 3), 0.2140, np.float32))
    shown = decoded(result_jpeg(tmp_path / "grey.exr"))
    assert shown.shape == (19, WIDEST_PX, 3)
    assert np.abs(shown.astype(int) - 128).max() <= 1
