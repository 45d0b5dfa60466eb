"""The pages: the reference is that of the commands, links lead somewhere, every page is on the map, tutorials run, the site builds."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote

import pytest

import mrbokeh
from datasets_scripts.commands_page import PAGE, commands_page

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [*ROOT.glob("*.md"), *sorted(DOCS.rglob("*.md"))]
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
SHELL = 'set -e\nmrbokeh() { "$PYTHON" -m mrbokeh.cli "$@"; }\npython() { "$PYTHON" "$@"; }\n'


def links(page: Path) -> list[Path]:
    """Return the files that the links and pictures of a page name."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = (unquote(target.split("#")[0]) for target in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in target)
    return [(page.parent / target).resolve() if target else page for target in targets]


def test_the_reference_of_commands_is_that_of_the_program() -> None:
    assert PAGE.read_text(encoding="utf-8") == commands_page(), "write it anew: python -m datasets_scripts.commands_page"


def test_the_reference_of_python_has_every_public_name() -> None:
    page = (DOCS / "reference" / "python.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"auto(?:class|function|exception):: ([A-Za-z_]+)(?:\(\))?$", page, re.MULTILINE)) == sorted(mrbokeh.__all__)


def test_links_and_pictures_exist() -> None:
    assert not [(page.name, target.name) for page in PAGES for target in links(page) if not target.exists()]


def test_every_page_is_reachable_from_the_map() -> None:
    found, waiting = set[Path](), [DOCS / "index.md"]
    while waiting:
        page = waiting.pop()
        found.add(page)
        waiting += [target for target in links(page) if target.suffix == ".md" and target not in found]
    assert set(PAGES) <= found


def test_tutorials_begin_with_what_comes_out() -> None:
    assert len(TUTORIALS) >= 6
    for page in TUTORIALS:
        assert 0 < page.read_text(encoding="utf-8").find("![") < 500, page.name


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_tutorials_run(page: Path, tmp_path: Path) -> None:
    """All but the viewfinder and the studio, which run until they are stopped, and what needs Mitsuba where there is none."""
    script = SHELL
    for language, block in re.findall(r"```(sh|python)\n(.*?)```", page.read_text(encoding="utf-8").replace("\\\n", ""), re.DOTALL):
        script += f"python <<'END'\n{block}END\n" if language == "python" else block
    left_out = r"mrbokeh studio|mrbokeh viewfinder (?!board)" + (
        "" if find_spec("mitsuba") else r"|python -m datasets_scripts.bokeh_stacks"
    )
    script = re.sub(rf"^(?:{left_out}).*\n", "", script, flags=re.MULTILINE)
    environment = os.environ | {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    made = re.findall(r"--out (\S+)", script)
    assert made and not [name for name in made if "%" not in name and not (tmp_path / name).exists()]


@pytest.mark.slow
@pytest.mark.skipif(not find_spec("sphinx"), reason="needs the extra docs")
def test_the_site_builds_without_warnings(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-c",
        "docs",
        "-d",
        str(tmp_path / "trees"),
        ".",
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "docs" / "index.html").is_file()
