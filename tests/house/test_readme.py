"""What README and guides promise: their commands exist with those options, their files exist, the Python runs, pages stay short."""

import re
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.main import get_command

from mrbokeh.cli import SUB_COMMANDS
from mrbokeh.images.image_io import write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDES = sorted((ROOT / "docs").glob("*.md"))
PAGES = {path: path.read_text(encoding="utf-8") for path in (ROOT / "README.md", ROOT / "ARCHITECTURE.md", *GUIDES)}
LONGEST_PAGE_BYTES = 8000


def blocks(language: str) -> list[str]:
    return [block for page in PAGES.values() for block in re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)]


def shell_lines() -> list[str]:
    return [line.split("#")[0].strip() for block in blocks("sh") for line in block.splitlines() if line.split("#")[0].strip()]


@cache
def options_of(name: str, *rest: str) -> set[str]:
    """Return the options of a command or, where its group has such a sub-command, of that."""
    command: Any = get_command(import_module(SUB_COMMANDS[name].module).app)
    for word in rest if hasattr(command, "commands") else ():
        command = command.commands[word]
    return {option for each in command.params for option in (*each.opts, *each.secondary_opts)} | {"--help"}


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = {line.split()[1] for line in shell_lines() if line.startswith("make ")} | set(re.findall(r"`make ([\w-]+)`", README))
    assert {"demo", "test"} <= targets
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)


def test_the_ci_runs_the_test_command_of_the_readme() -> None:
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


@pytest.mark.parametrize("line", sorted({line for line in shell_lines() if line.startswith("mrbokeh ")}))
def test_every_command_and_option_exists(line: str) -> None:
    words = line.split()[1:]
    command = [word for word in words[:2] if re.fullmatch(r"[a-z][a-z-]*", word)]
    assert {word for word in words if word.startswith("--")} <= options_of(*command)


def test_the_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    alpha = np.zeros((16, 24), np.float32)
    alpha[4:12, 6:18] = 1.0
    write_layer(
        tmp_path / "object.exr", Layer(np.repeat(alpha[..., None], 3, 2), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))
    )
    write_lens(tmp_path / "lens.json", Lens(50.0, 2.0, 1.0, 36.0))
    variables: dict[str, object] = {}
    exec(blocks("python")[0], variables)
    assert isinstance(variables["blurred"], Layer)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_linked_files_exist(page: Path) -> None:
    missing = [target for target in re.findall(r"\]\(([\w./]+)\)", PAGES[page]) if not (page.parent / target).exists()]
    assert not missing


def test_the_pages_that_newcomers_read_first_stay_short() -> None:
    assert all((ROOT / name).stat().st_size <= LONGEST_PAGE_BYTES for name in ("README.md", "ARCHITECTURE.md"))
