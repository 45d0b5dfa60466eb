"""The channel of all commands: --json, --quiet and --log, pipes, two runs into one output, and Ctrl-C."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from mrbokeh.cli import SUB_COMMANDS, command_of
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.system.atomic_files import atomic_folder, writing_alone
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import opened, write_object
from tests.support.command_line import mrbokeh
from tests.support.refusals import refused

NEW = ("--focal-length", 50, "--f-number", 2, "--focus", 0.4)
HOLDING = (
    "import sys, time; from pathlib import Path; from mrbokeh.system.atomic_files import writing_alone\n"
    "with writing_alone(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
)
SLEEPING = (
    "import sys, time; from concurrent.futures import ThreadPoolExecutor; import mrbokeh.optics.lens_file as file\n"
    "from mrbokeh import cli; from mrbokeh.system.atomic_files import atomic_path\n"
    "def slow(path, lens):\n"
    "    with atomic_path(path) as temporary, ThreadPoolExecutor(1) as pool:\n"
    "        temporary.touch(); print('begun', file=sys.__stderr__, flush=True); pool.submit(time.sleep, 30).result()\n"
    "file.write_lens = slow; sys.argv[0] = 'mrbokeh'; cli.main()"
)


SPEAKING = (
    "import sys; import mrbokeh.optics.lens_file as file\n"
    "from mrbokeh import cli; from mrbokeh.system import messages; from rich.table import Table\n"
    "def speak(path, lens):\n"
    "    messages.say('a hint'); messages.warn('careful'); print('noise', file=sys.stderr); messages.tell('the result')\n"
    "    table = Table('of two', box=None); messages.show(table); sys.exit()\n"
    "file.write_lens = speak; sys.argv[0] = 'mrbokeh'; cli.main()"
)


def speaking(folder: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    """Run a command that says, warns, tells and shows."""
    words = [sys.executable, "-c", SPEAKING, "lens", "new", str(folder / "lens.json"), *map(str, NEW), *options]
    return subprocess.run(words, capture_output=True, text=True)


def run_commands(command: object, path: str) -> dict[str, set[str]]:
    """Options by command, of those that run and of groups that run by themselves."""
    found = {k: v for name, each in getattr(command, "commands", {}).items() for k, v in run_commands(each, f"{path} {name}").items()}
    if not hasattr(command, "commands") or command.invoke_without_command:
        found[path] = {option for parameter in command.params for option in parameter.opts}  # type: ignore[attr-defined]
    return found


def test_every_command_has_them() -> None:
    found = {k: v for name in SUB_COMMANDS for k, v in run_commands(command_of(name), name).items()}
    assert len(found) >= 38 and all({"--json", "--quiet", "--log"} <= options for options in found.values())


def test_one_object_of_what_was_done_and_words_elsewhere(tmp_path: Path) -> None:
    lens, figure = tmp_path / "lens.json", tmp_path / "lens.png"
    done = mrbokeh("lens", "new", lens, *NEW, "--json")
    told = json.loads(done.stdout)
    assert (told["command"], told["outputs"], told["exit_code"]) == ("lens new", [str(lens)], 0) and f"wrote {lens}" in done.stderr
    told = json.loads(mrbokeh("lens", "show", lens, "--out", figure, "--json").stdout)
    assert told["inputs"] == {"lens": str(lens)} and told["outputs"] == [str(figure)] and 0 < told["seconds"] < 60
    assert json.loads(mrbokeh("lens", "show", lens, "--out", figure, "--json").stdout)["inputs"] == {"lens": str(lens)}  # refused
    assert json.loads(mrbokeh("lens", "coc", lens, 0.4, "inf", "--json").stdout)["figures"]["coc_px"][0] == pytest.approx(0.0, abs=1e-6)
    for words, said in ((("lens", "coc", tmp_path / "none.json", 1), "no such file"), (("lens", "new", "--nonsense"), "--nonsense")):
        done = mrbokeh(*words, "--json")
        assert done.returncode == 2 and said in json.loads(done.stdout)["error"] and "error: " in done.stderr


def test_numbers_that_json_lacks_are_text(capsys: pytest.CaptureFixture[str]) -> None:
    with opened() as channel:
        channel.figures |= {"far_m": float("inf"), "nothing": float("nan"), "path": Path("a"), "deep": [{"b": (-float("inf"),)}]}
        write_object(sys.stdout, 0, "")
    assert json.loads(capsys.readouterr().out)["figures"] == {"far_m": "inf", "nothing": None, "path": "a", "deep": [{"b": ["-inf"]}]}


def test_only_the_folder_that_came_whole_is_an_output(tmp_path: Path) -> None:
    with opened() as channel, atomic_folder(tmp_path / "bank") as folder:
        (folder / "a").touch()
    assert channel.written() == [tmp_path / "bank"]


def test_quiet_leaves_the_result_and_errors(tmp_path: Path) -> None:
    found = speaking(tmp_path, "--quiet")
    assert (found.stdout, found.stderr) == ("the result\n of two \n", "")
    done = mrbokeh("lens", "show", tmp_path / "dark.exr", "--out", tmp_path / "a.png", "--quiet")
    assert done.returncode == 2 and done.stdout == "" and done.stderr.startswith("error: ")


@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_a_log_grows_by_all_that_is_said(tmp_path: Path, quiet: tuple[str, ...]) -> None:
    """Each line with its time, tables too; only its owner may read it."""
    log = tmp_path / "log.txt"
    speaking(tmp_path, "--log", str(log), *quiet)
    mrbokeh("lens", "new", tmp_path / "none.png", *NEW, "--log", log)
    lines = [line.split(maxsplit=2) for line in log.read_text().splitlines()]
    assert all(day[:2] == "20" for day, *_ in lines) and (os.name == "nt" or log.stat().st_mode & 0o777 == 0o600)
    said = [rest[1].split()[0] for _, *rest in lines if len(rest) > 1]
    assert said == ["mrbokeh", "a", "warning:", "the", "of", "mrbokeh", "error:"]


def test_a_log_is_never_what_is_read_or_written(tmp_path: Path) -> None:
    lens = tmp_path / "lens.json"
    done = mrbokeh("lens", "new", lens, *NEW, "--log", lens)
    assert done.returncode == 2 and f"--log {lens} would be written into what OUT names" in done.stderr and not list(tmp_path.iterdir())
    done = mrbokeh("render", "--out", "a.png", "--rgb", lens, "--depth", 2, "--log", tmp_path / "." / "lens.json")
    assert done.returncode == 2 and "into what --rgb names" in done.stderr and not list(tmp_path.iterdir())


def test_a_pipe_that_nobody_reads_is_no_fault() -> None:
    for words in ("--help", "lens coc --help"):
        line = f"{sys.executable} -m mrbokeh.cli {words} 2>&1 | head -c 1"
        assert len(subprocess.run(["bash", "-c", line], capture_output=True, text=True).stdout) == 1
        unread = f"({sys.executable} -m mrbokeh.cli {words} --json) 2>&1 >/dev/full | grep -c Traceback"
        assert subprocess.run(["bash", "-c", unread], capture_output=True, text=True).stdout == "0\n"


def test_two_runs_into_one_output(tmp_path: Path) -> None:
    out = tmp_path / "lens.json"
    with subprocess.Popen([sys.executable, "-c", HOLDING, str(out)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        done = mrbokeh("lens", "new", out, *NEW)
        assert done.returncode == 2 and f"another run (process {other.pid}) is writing {out}" in done.stderr
        (tmp_path / ".lens.json.lock").write_text("")
        refused(f"another run is writing {out}", raising_while_writing, out)
        other.kill()  # the lock goes with the process, the file that held it stays
    assert mrbokeh("lens", "new", out, *NEW).returncode == 0 and [each.name for each in tmp_path.iterdir()] == ["lens.json"]


def test_a_lock_leaves_no_folder_and_reaches_through_links(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused("a mistake", raising_while_writing, tmp_path / "new" / "deep" / "out.png")
    assert not list(tmp_path.iterdir()) and not capsys.readouterr().out
    for _ in range(2):  # the folder is made, and told of, once
        with writing_alone(tmp_path / "made" / "out.png"):
            (tmp_path / "made" / "out.png").touch()
    assert capsys.readouterr().out == f"the folder {tmp_path / 'made'} did not exist and was made\n"
    (tmp_path / "scene").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "scene")
    with writing_alone(tmp_path / "scene"):
        assert (tmp_path / ".scene.lock").read_text() == str(os.getpid())
        with pytest.raises(InputError, match="another run"), writing_alone(tmp_path / "link"):
            pass


def raising_while_writing(path: Path) -> None:
    with writing_alone(path):
        raise InputError("a mistake")


@pytest.mark.skipif(os.name == "nt", reason="no such signals there")
@pytest.mark.parametrize("option", ["--quiet", "--json"])
def test_an_interrupt_ends_within_two_seconds_with_one_line(tmp_path: Path, option: str) -> None:
    """Even while a thread computes on, as compiled kernels do."""
    words = [sys.executable, "-c", SLEEPING, "lens", "new", str(tmp_path / "lens.json"), *map(str, NEW), option]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None and run.stderr is not None and run.stderr.readline() == "begun\n"
        asked_s = time.monotonic()
        run.send_signal(signal.SIGINT)
        assert run.wait(10) == 130 and time.monotonic() - asked_s < 2.5
        assert run.stderr.read() == "stopped: nothing was written\n"
        told = json.loads(run.stdout.read() or "{}")
        assert told.get("exit_code") == (130 if option == "--json" else None)
    assert not list(tmp_path.iterdir())


def test_nobody_speaks_past_the_channel() -> None:
    """A program of its own and the compiler's listener, which kernels depend on, print; tables and bars go to the consoles here."""
    root = Path(__file__).resolve().parents[2]
    speaking = {root / "mrbokeh/system" / name for name in ("messages.py", "compiled.py")} | {root / "mrbokeh/cli.py"}
    speaking.add(root / "capture/poses/colmap_worker.py")
    for package in ("mrbokeh", "capture", "training", "viewfinder"):
        for path in sorted((root / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            assert path in speaking or not re.search(r"typer\.echo|(?<![.\w])print\(|[^r]Console\(\)", text), path


@pytest.mark.skipif(sys.platform == "win32", reason="needs a terminal of its own, which Windows has not")
def test_a_terminal_shows_at_once_what_runs_and_keeps_only_the_words(tmp_path: Path) -> None:
    import pty

    write_lens(tmp_path / "lens.json", Lens.default())
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ["TERM"] = "xterm"
        os.execv(sys.executable, [sys.executable, "-m", "mrbokeh.cli", "lens", "coc", str(tmp_path / "lens.json"), "1", "2"])
    seen = b""
    with suppress(OSError):  # the terminal is gone when the command has ended
        while part := os.read(terminal, 4096):
            seen += part
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert seen.index(b"lens ...") < seen.index(b"1 m: ")
    words = seen[seen.index(b"1 m: ") :]
    for line in re.findall(rb"[12] m: [^\r\n]*", words):
        assert b"..." not in line and b"\x1b" not in line
    erased, shown = b"\x1b[2K", b"\x1b[?25h"
    assert seen.rindex(erased) > seen.rindex(b"lens ...") and seen.rindex(shown) > seen.rindex(b"\x1b[?25l")
