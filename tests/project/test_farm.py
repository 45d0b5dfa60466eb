"""Templates of render farms: each is what its manager reads, and its command is one of ours, by the parser of the program."""

import json
import re
import shlex
from pathlib import Path
from xml.etree import ElementTree

import pytest
from typer.main import get_command

from mrbokeh.commands.video import app
from mrbokeh.video.picture_source import parse_frames

FARM = Path(__file__).resolve().parents[2] / "examples" / "farm"


def key_values(name: str) -> dict[str, str]:
    """The form of Deadline's job and plugin files."""
    return dict(line.split("=", 1) for line in (FARM / name).read_text(encoding="utf-8").splitlines() if line)


def deadline() -> list[str]:
    job, plugin = key_values("deadline_job.txt"), key_values("deadline_plugin.txt")
    assert job["Plugin"] == "CommandLine" and parse_frames(job["Frames"]) and int(job["ChunkSize"]) > 0
    told = plugin["Arguments"].replace("<STARTFRAME>", "1001").replace("<ENDFRAME>", "1010")
    return [plugin["Executable"], *shlex.split(told)]


def opencue() -> list[str]:
    layer = ElementTree.parse(FARM / "opencue.xml").getroot().find("job/layers/layer")
    assert layer is not None and parse_frames(str(layer.findtext("range"))) and int(str(layer.findtext("chunk"))) > 0
    # The scheduler writes 1001-1010, or 1001-1009x2, or 1001.
    return shlex.split(str(layer.findtext("cmd")).replace("#FRAMESPEC#", "1001-1009x2"))


def flamenco() -> list[str]:
    text = (FARM / "flamenco_mrbokeh.js").read_text(encoding="utf-8")
    settings = dict(re.findall(r'key: "(\w+)".*?description: "([^"]*)"', text))
    exe, words = re.search(r'exe: "(\w+)",\s*args: (\[.*?\]),\n', text, re.DOTALL).groups()  # type: ignore[union-attr]
    named = re.sub(r"settings\.(\w+)", lambda found: json.dumps(settings[found[1]].split()[0].rstrip(",")), words)
    # As the Manager cuts frames into chunks: 1001-1010, and 1011,1012 for two.
    return [exe, *json.loads(named.replace("chunk,", '"1011,1012",'))]


@pytest.mark.parametrize("template", [deadline, opencue, flamenco])
def test_commands_of_templates_are_ours(template: object) -> None:
    program, command, *words = template()  # type: ignore[operator]
    assert (program, command) == ("mrbokeh", "video")
    words.remove("--json")  # of every command, taken by the program
    given = get_command(app).make_context("video", words).params
    assert given["clip"].name == "plate.%04d.exr"
    assert parse_frames(given["frames"])[0][0] in (1001, 1011)
    assert "%04d" in str(given["out"]) and given["overwrite"]
    with pytest.raises(Exception, match="No such option"):
        get_command(app).make_context("video", [*words, "--frame-range", "1-2"])
