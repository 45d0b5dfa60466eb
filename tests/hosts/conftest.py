"""A running `mrbokeh serve` for all tests of hosts."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


def started(connection: Path, *more: object) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "mrbokeh.cli", "serve", "--connection", str(connection), *map(str, more)]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert server.stdout is not None and "Ctrl-C ends it" in server.stdout.readline()
    return server


@pytest.fixture(scope="package")
def connection(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The connection file of a running server, which ends as by Ctrl-C."""
    path = tmp_path_factory.mktemp("serve") / "server.json"
    server = started(path)
    yield str(path)
    server.send_signal(signal.SIGINT)
    said, _ = server.communicate(timeout=10)
    assert not path.exists() and "stopped: " in said
