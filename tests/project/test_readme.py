"""What all pages promise: their commands exist with those options, their files exist, the Python runs, pages stay short."""

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mrbokeh as mb
from mrbokeh.cli import command_of
from tests.support.shipped_photographs import DATA, few_small_photographs

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDES = sorted((ROOT / "docs").rglob("*.md"))
PAGES = {path: path.read_text(encoding="utf-8") for path in (*ROOT.glob("*.md"), *GUIDES)}
LONGEST_PAGE_BYTES = 8000


def blocks(language: str) -> list[str]:
    return [block for page in PAGES.values() for block in re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)]


def shell_lines() -> list[str]:
    lines = (line.split("#")[0].strip() for block in blocks("sh") for line in block.replace("\\\n", " ").splitlines())
    return [line for line in lines if line]


@cache
def options_of(name: str, *rest: str) -> set[str]:
    """Return the options of a command or, where its group has such a sub-command, of that."""
    command: Any = command_of(name)
    for word in rest if hasattr(command, "commands") else ():
        command = command.commands[word]
    return {option for each in command.params for option in (*each.opts, *each.secondary_opts)} | {"--help"}


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = {line.split()[1] for line in shell_lines() if line.startswith("make ")} | set(re.findall(r"`make ([\w-]+)`", README))
    assert {"demo", "test"} <= targets and all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_every_command_and_option_exists() -> None:
    lines = {line for line in shell_lines() if line.startswith("mrbokeh ")}
    assert len(lines) > 30
    for line in lines:
        words = line.split()[1:]
        command = [word for word in words[:2] if re.fullmatch(r"[a-z][a-z-]*", word)]
        assert {word for word in words if word.startswith("--")} <= options_of(*command), line


def test_the_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    few_small_photographs(tmp_path / "desk")
    (tmp_path / "cake.glb").symlink_to(DATA / "objects" / "cakeBirthday.glb")
    rng = np.random.default_rng(0)
    variables = {"picture": rng.uniform(0.0, 1.0, (80, 120, 3)), "depth_m": rng.uniform(1.0, 2.0, (80, 120))}
    exec(blocks("python")[0], variables)
    assert variables["blurred"].shape == (80, 120, 3)
    assert mb.read_picture(tmp_path / "with_cake.png").shape == variables["with_cake"].shape == variables["merged"].all_in_focus.shape


def test_linked_files_exist_and_the_pages_that_newcomers_read_first_stay_short() -> None:
    linked = [(page, target) for page, text in PAGES.items() for target in re.findall(r"\]\(([\w./]+)\)", text)]
    assert not [(page.name, target) for page, target in linked if not (page.parent / target).exists()]
    assert all((ROOT / name).stat().st_size <= LONGEST_PAGE_BYTES for name in ("README.md", "ARCHITECTURE.md"))
