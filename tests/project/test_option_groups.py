"""Options in groups make the very command line that options one by one make."""

from dataclasses import dataclass
from typing import Annotated, Any

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from mrbokeh.cli import SUB_COMMANDS, command_of
from mrbokeh.commands import check, composite, refocus, render, transfer, video
from mrbokeh.commands._option_groups import grouped
from mrbokeh.commands._option_words import CHOICES, EVERYDAY, METAVARS, PANELS


@dataclass(frozen=True)
class Size:
    width: Annotated[int, typer.Option(min=1)] = 3
    height_: Annotated[int | None, typer.Option("--height")] = None


@dataclass(frozen=True)
class Named(Size):
    name: Annotated[str, typer.Option()] = "nobody"
    width: Annotated[int, typer.Option(min=1)] = 5


def made_app(*, of: type) -> typer.Typer:
    app = typer.Typer()

    def command(where: Annotated[str, typer.Argument()], size, loud: bool = False) -> None:  # type: ignore[no-untyped-def]
        """Says what came."""
        typer.echo(f"{where} {size} {loud}")

    command.__annotations__["size"] = of
    app.command()(grouped(command))
    return app


def said(*words: str, of: type = Size) -> str:
    return CliRunner().invoke(made_app(of=of), list(words)).output.strip()


def test_a_group_comes_whole_and_a_command_may_add_to_it_and_change_its_defaults() -> None:
    assert said("there") == "there Size(width=3, height_=None) False"
    assert said("there", "--height", "7", "--loud", "--width", "2") == "there Size(width=2, height_=7) True"
    assert said("there", "--height", "7", of=Named) == "there Named(width=5, height_=7, name='nobody') False"
    assert CliRunner().invoke(made_app(of=Size), ["there", "--width", "0"]).exit_code == 2, "what an option asks is checked"
    assert "Says what came" in said("--help")


def test_every_option_says_what_it_is() -> None:
    for module in (check, composite, refocus, render, transfer, video):
        assert all(getattr(each, "help", None) for each in get_command(module.app).params), module


def test_composite_and_video_share_what_they_can() -> None:
    """Same names, same words, same defaults."""
    one, other = ({each.name: each for each in get_command(each.app).params} for each in (composite, video))
    shared = {
        "layer",
        "objects",
        "scene",
        "camera",
        "mode",
        "matte",
        "near_distance",
        "scene_renderer",
        "paths",
        "disparity",
        "focus_at",
        "catch",
        "distortion",
    }
    shared |= {"match_grey", "match_exposure", "match_white", "match_black", "vignetting", "grain", "light_wrap", "seed", "grey_value"}
    shared |= {"focal_length_mm", "f_number", "sensor_width_mm", "input_space", "output_space", "ocio", "overwrite", "plate_exposure"}
    assert shared <= one.keys() & other.keys()
    assert all(one[name].help == other[name].help for name in shared)  # type: ignore[attr-defined]
    assert all(one[name].default == other[name].default for name in shared)


EXCEPTIONS = {
    "--focus": "transfer and refocus make several pictures, so there it is a list of distances as well",
    "--board": "of a scene also the size of the board in squares",
    "--ruler": "of a clip it names its frame; of a stack there may be several",
    "--lens": "the page of the viewfinder switches between several",
    "--renderer": "the viewfinder switches between several, training compares several",
    "--layer": "the viewfinder shows one",
    "--white-balance": "in the words of what develops: the camera, or LibRaw",
    "--out": "each command names what it makes",
    "--height": "an object's may be in pixels; a camera's above the ground is in metres",
}
"""Options whose type or unit may differ between commands."""


def commands(command: Any, path: str) -> dict[str, Any]:
    """Commands by their whole names, with groups that run by themselves."""
    inner = {k: v for name, each in getattr(command, "commands", {}).items() for k, v in commands(each, f"{path} {name}").items()}
    return inner if hasattr(command, "commands") and not command.invoke_without_command else inner | {path: command}


@pytest.fixture(scope="module")
def every() -> dict[str, Any]:
    return {k: v for name in SUB_COMMANDS for k, v in commands(command_of(name), name).items()}


def options_of_all(every: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Parameters by option and command."""
    found: dict[str, dict[str, Any]] = {}
    for path, command in every.items():
        for parameter in command.params:
            for option in (word for word in parameter.opts if word.startswith("--")):
                found.setdefault(option, {})[path] = parameter
    return found


def test_a_name_means_the_same_everywhere(every: dict[str, Any]) -> None:
    """The same type, and the same unit or word for what it takes."""
    differing = {}
    for option, by_command in options_of_all(every).items():
        kinds = {(str(each.type_descriptor.annotation), each.metavar, tuple(each.secondary_opts)) for each in by_command.values()}
        if len(kinds) > 1:
            differing[option] = dict.fromkeys(by_command, kinds)
    assert set(differing) == set(EXCEPTIONS), differing
    assert all(len(parameter.opts) == 1 for command in every.values() for parameter in command.params), "one name for one thing"


def test_words_are_of_options_that_exist(every: dict[str, Any]) -> None:
    """In the tables of panels, units, choices and everyday options; every option of a long list has a subject."""
    options = {name.removeprefix("--") for name in options_of_all(every)} | {"model"}
    named = {name for table in (PANELS, METAVARS) for names in table.values() for name in names.split()} | {
        name.split()[-1] for name in CHOICES
    }
    assert named <= options, named - options
    for path, names in EVERYDAY.items():
        own = {parameter.opts[0].removeprefix("--") for parameter in every[path].params}
        assert set(names.split()) <= own and len(names.split()) <= 8, path
    for path, command in every.items():
        assert sum(parameter.rich_help_panel == "More" for parameter in command.params) <= 6, path


def test_the_shell_offers_cameras_where_one_is_taken(every: dict[str, Any]) -> None:
    def offered(command: str, name: str) -> list[str]:
        parameter = next(each for each in every[command].params if each.name == name)
        return [each.value for each in parameter.shell_complete(None, "")]

    assert "whip" in offered("viewfinder", "source") and "whip" not in offered("capture shoot", "source")
    assert "gphoto2" not in offered("track convert", "source")


def test_choices_that_the_shell_offers_are_those_that_commands_take() -> None:
    from capture.stacks.grouping import Grouping
    from mrbokeh.commands.lens import SHAPES
    from mrbokeh.compositing.choose import MODES
    from mrbokeh.depth.depth_map import GIVES
    from mrbokeh.renderers.choose import BY_NAME
    from mrbokeh.video.encodings import ENCODINGS

    offered = {name: set(values.split()) for name, values in CHOICES.items()}
    taken = {"group": Grouping, "mode": MODES, "renderer": BY_NAME, "depth-model-gives": GIVES, "shape": SHAPES, "encoding": ENCODINGS}
    assert {name: offered[name] ^ set(values) for name, values in taken.items()} == {name: set() for name in taken}


def test_one_thing_has_one_name(every: dict[str, Any]) -> None:
    """Where the focus lies, the lens's length, its sensor, the width of pictures, the nearest and farthest distance, their rate."""
    options = options_of_all(every)
    for other in (
        "focus-distance-m",
        "focal-length-mm",
        "sensor-width-mm",
        "image-width-px",
        "nearest-m",
        "farthest-m",
        "frame-rate",
        "fps",
    ):
        assert f"--{other}" not in options, options.get(f"--{other}")
    overridden = {"render", "composite", "video", "transfer", "refocus"}
    for option in ("--focus", "--focus-at", "--focal-length", "--f-number", "--sensor-width"):
        assert overridden <= set(options[option]), option
    assert overridden - {"refocus"} <= set(options["--disparity"]), "a stack has its depth in metres"
    assert {"lens new", "lens match", "lens psf"} <= set(options["--focus"])
    assert {"lens new", "lens match", "lens psf", "capture plan", "track convert"} <= set(options["--sensor-width"])
    assert {"video", "transfer", "track convert"} <= set(options["--rate"])
    assert {"capture process", "capture report", "capture ingest", "capture merge"} <= set(options["--overwrite"])
