"""One name for one thing in all commands; what options were called before goes on working, unseen."""

from importlib import import_module
from typing import Any

import click
import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from mrbokeh.cli import SUB_COMMANDS
from mrbokeh.commands._former_names import formerly, renamed


def made_app() -> typer.Typer:
    app = typer.Typer()

    @app.command(cls=formerly("focus_distance_m", range="--far"))
    def say(words: list[str], focus: float = 1.0, far: float = 3.0) -> None:
        typer.echo(f"{focus} {' '.join(words)} {far}")

    return app


@pytest.mark.parametrize(
    "given", [["--focus", "2", "--far", "5"], ["--focus-distance-m", "2", "--range", "5"], ["--focus-distance-m=2", "--range=5"]]
)
def test_both_spellings_mean_the_same(given: list[str]) -> None:
    assert CliRunner().invoke(made_app(), [*given, "word"]).stdout == "2.0 word 5.0\n"


def test_the_former_one_is_hidden_and_mistakes_name_the_new_one() -> None:
    assert "focus-distance" not in CliRunner().invoke(made_app(), ["--help"]).stdout
    refused = CliRunner().invoke(made_app(), ["--focus-distance-m", "near", "word"], color=False)
    assert refused.exit_code == 2 and "--focus" in refused.output and "focus-distance" not in refused.output


def test_values_and_what_follows_two_dashes_are_left_alone() -> None:
    names = {"--old": "--new"}
    assert renamed(["--old", "1", "old", "--older", "--", "--old"], names) == ["--new", "1", "old", "--older", "--", "--old"]


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
    for former in ("focus-distance-m", "focal-length-mm", "sensor-width-mm", "image-width-px", "nearest-m", "farthest-m", "frame-rate"):
        assert f"--{former}" not in options, options.get(f"--{former}")
    assert {"render", "composite", "transfer", "refocus", "lens new", "lens match", "lens psf"} <= options["--focus"]
    assert {"lens new", "lens match", "lens psf", "capture plan", "track convert"} <= options["--sensor-width"]
    assert {"video", "transfer", "track convert"} <= options["--rate"]
    assert {"capture process", "capture report", "capture ingest", "capture merge"} <= options["--overwrite"]
