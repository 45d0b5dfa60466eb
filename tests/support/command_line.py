"""Commands called in this process: the whole command line, as a process of its own would answer, and single commands."""

import contextlib
import io
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import cache

import pytest
import typer
import typer.testing
from typer.testing import CliRunner

from mrbokeh import cli
from mrbokeh.cli import main

# Commands are made once for all calls of a test run: their hundred options take as long as many a small picture.
_made = cache(typer.main.get_command)
_command_of = cache(cli.command_of)


def mrbokeh(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `mrbokeh ARGUMENTS`. A process takes half a second to start: where it is not itself the subject, this stands for it."""
    words, out, err = list(map(str, arguments)), io.StringIO(), io.StringIO()
    interrupt, code = signal.getsignal(signal.SIGINT), 0
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["mrbokeh", *words])
        patch.setattr(cli, "command_of", _command_of)
        for name, value in ({"COLUMNS": "200", "NO_COLOR": "1"} | environment).items():
            patch.setenv(name, value)
        try:
            main()
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else int(left.code is not None)
        finally:
            signal.signal(signal.SIGINT, interrupt)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def printed_by(command: typer.Typer | Callable[..., None], *words: object, exit_code: int = 0, answer: str = "") -> str:
    """What a command prints on a wide terminal, which must end with this exit code; what it raises is raised here."""
    app = command if isinstance(command, typer.Typer) else _app_of(command)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.testing, "_get_command", _made)
        result = CliRunner().invoke(app, [str(each) for each in words], input=answer, env={"COLUMNS": "400"}, catch_exceptions=False)
    assert result.exit_code == exit_code, result.output
    return result.output


@cache
def _app_of(command: Callable[..., None]) -> typer.Typer:
    app = typer.Typer()
    app.command()(command)
    return app
