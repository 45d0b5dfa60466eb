"""The command line called in this process, as a process of its own would answer: its code, what it prints and what it says of mistakes."""

import contextlib
import io
import signal
import subprocess
import sys

import pytest

from mrbokeh.cli import main


def mrbokeh(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `mrbokeh ARGUMENTS`. A process takes half a second to start: where it is not itself the subject, this stands for it."""
    words, out, err = list(map(str, arguments)), io.StringIO(), io.StringIO()
    interrupt, code = signal.getsignal(signal.SIGINT), 0
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["mrbokeh", *words])
        for name, value in ({"COLUMNS": "200", "NO_COLOR": "1"} | environment).items():
            patch.setenv(name, value)
        try:
            main()
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else int(left.code is not None)
        finally:
            signal.signal(signal.SIGINT, interrupt)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())
