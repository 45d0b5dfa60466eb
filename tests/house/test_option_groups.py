"""Options in groups make the very command line that options one by one make."""

from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any

import click
import typer
from typer.main import get_command
from typer.testing import CliRunner

from mrbokeh.cli import SUB_COMMANDS
from mrbokeh.commands import check, composite, refocus, render, transfer, video
from mrbokeh.commands._option_groups import grouped


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
    """Same names, same words, same defaults but for the renderer of scenes: of a photograph the exact one."""
    one, other = ({each.name: each for each in get_command(each.app).params} for each in (composite, video))
    shared = {"layer", "objects", "scene", "camera", "mode", "matte", "near_distance", "scene_renderer", "samples", "catch", "distortion"}
    shared |= {"match_grey", "match_exposure", "match_white", "match_black", "vignetting", "grain", "light_wrap", "seed", "grey_value"}
    shared |= {"input_space", "output_space", "ocio", "overwrite", "plate_exposure"}
    assert shared <= one.keys() & other.keys()
    assert all(one[name].help == other[name].help for name in shared)  # type: ignore[attr-defined]
    assert {name for name in shared if one[name].default != other[name].default} == {"scene_renderer"}


def commands(command: Any, path: tuple[str, ...]) -> dict[tuple[str, ...], click.Command]:
    if hasattr(command, "commands"):
        return {k: v for name, each in command.commands.items() for k, v in commands(each, (*path, name)).items()}
    return {path: command}


def options_of_all() -> dict[str, set[str]]:
    """Commands by option."""
    found: dict[str, set[str]] = {}
    for name, each in SUB_COMMANDS.items():
        for path, command in commands(get_command(import_module(each.module).app), (name,)).items():
            for option in (word for parameter in command.params for word in parameter.opts if word.startswith("--")):
                found.setdefault(option, set()).add(" ".join(path))
    return found


def test_one_thing_has_one_name() -> None:
    """Where the focus lies, the lens's length, its sensor, the width of pictures, the nearest and farthest distance, pictures a second."""
    options = options_of_all()
    for other in ("focus-distance-m", "focal-length-mm", "sensor-width-mm", "image-width-px", "nearest-m", "farthest-m", "frame-rate"):
        assert f"--{other}" not in options, options.get(f"--{other}")
    assert {"render", "composite", "transfer", "refocus", "lens new", "lens match", "lens psf"} <= options["--focus"]
    assert {"lens new", "lens match", "lens psf", "capture plan", "track convert"} <= options["--sensor-width"]
    assert {"video", "transfer", "track convert"} <= options["--rate"]
    assert {"capture process", "capture report", "capture ingest", "capture merge"} <= options["--overwrite"]
