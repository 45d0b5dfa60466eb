"""Build the gallery: run every example of docs/examples.md and show what it made.

    python -m datasets_scripts.gallery gallery_out [--demo demo_out] [--only composite,video] [--update]

The page is the only list of examples: a heading, a `sh` block, a picture, and a comment that says which of the files that the block
made the picture shows (`<!-- shows: out.png -->`), or which page to look at while its last command runs (`<!-- page: http://... -->`).
They run in OUT, where demo_out leads to a finished demo and repository to this repository. Finished commands and pictures are kept,
so that an interrupted run goes on; after a command has changed, begin with an empty folder. OUT/gallery.html shows all; --update puts the
pictures into docs/pictures, where the examples show them.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from datasets_scripts.gallery.pictures import page_jpeg, result_jpeg
from datasets_scripts.made_sets.set_files import mistakes_told
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.system.html_page import inline_figure, write_page

_ENTRY = re.compile(
    r"^## (?P<title>[^\n]+)\n(?:(?!^#).)*?```sh\n(?P<commands>.*?)```\n+!\[(?P<caption>[^\]]*)\]\((?P<picture>[^)]+)\)\n"
    r"<!-- (?P<kind>shows|page): (?P<source>[^\n]+?) -->",
    re.DOTALL | re.MULTILINE,
)
ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "docs" / "examples.md"
FINISHED = ".finished"
FINDS = 1
"""`mrbokeh check` ends with it where it found something, which is what its example shows."""


@dataclass(frozen=True)
class Entry:
    """An example. picture: its path from the page. Either `shows`, files that the commands make (side by side), or `page`, an address."""

    title: str
    commands: tuple[str, ...]
    caption: str
    picture: Path
    shows: str = ""
    page: str = ""


def read_entries(page: str) -> list[Entry]:
    """Return all examples with a picture, in order. Raises InputError where there is none."""
    entries = [_entry(found) for found in _ENTRY.finditer(page)]
    if not entries:
        raise InputError(
            "expected examples with pictures in docs/examples.md (## title, sh block, picture, <!-- shows: FILE -->), found none"
        )
    return entries


def _entry(found: re.Match[str]) -> Entry:
    joined = found["commands"].replace("\\\n", " ")
    commands = tuple(line for line in (_without_comment(line) for line in joined.splitlines()) if line)
    source = {found["kind"]: found["source"]}
    return Entry(found["title"].replace("`", ""), commands, found["caption"], Path(found["picture"]), **source)


def _without_comment(line: str) -> str:
    return re.sub(r"\s+#.*", "", line).strip()


def build(out: Path, entries: list[Entry], demo: Path) -> None:
    """Make what is missing, in the order of the page, for examples use one another's results; and the page of all."""
    if not (demo / "report.html").is_file():
        raise InputError(f"expected a finished demo in {demo}: run `mrbokeh demo --out {demo}` first")
    _link(out / "demo_out", demo)
    _link(out / "repository", ROOT)
    for entry in track(entries, "building the gallery"):
        if not (out / entry.picture.name).is_file():
            data = _made(entry, out)
            with atomic_path(out / entry.picture.name) as temporary:
                temporary.write_bytes(data)
    write_page(out / "gallery.html", "mrbokeh: every command and what it makes", [_section(entry, out) for entry in entries])


def _made(entry: Entry, out: Path) -> bytes:
    *first, last = entry.commands
    for command in first:
        _run(command, out)
    if entry.page:
        return page_jpeg(_words(last), entry.page, out)
    _run(last, out)
    return result_jpeg(*(out / name for name in entry.shows.split()))


def _run(command: str, out: Path) -> None:
    """Run a command unless it ran before. The whole demo was finished before all this, in the folder that the link leads to."""
    finished = out / FINISHED
    before = finished.read_text(encoding="utf-8").splitlines() if finished.is_file() else []
    if command in before or (command.startswith("mrbokeh demo ") and "--quick" not in command):
        return
    done = subprocess.run(_words(command), cwd=out, env=_with_scripts(), capture_output=True, text=True)
    if done.returncode not in ((0, FINDS) if command.startswith("mrbokeh check ") else (0,)):
        raise InputError(
            f"expected `{command}` to end well, but it ended with {done.returncode}: {done.stderr.strip() or done.stdout.strip()}"
        )
    with atomic_path(finished) as temporary:
        temporary.write_text("\n".join([*before, command]), encoding="utf-8")


def _with_scripts() -> dict[str, str]:
    """Return an environment in which `python -m datasets_scripts...` is found from any folder."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}


def _words(command: str) -> list[str]:
    """Split a command; `mrbokeh` and `python` become those that run this."""
    program, *words = shlex.split(command)
    own = {"mrbokeh": [sys.executable, "-m", "mrbokeh.cli"], "python": [sys.executable]}
    return [*own.get(program, [program]), *words]


def _link(link: Path, folder: Path) -> None:
    link.parent.mkdir(parents=True, exist_ok=True)
    if not link.exists():
        link.symlink_to(folder.resolve(), target_is_directory=True)


def _section(entry: Entry, out: Path) -> str:
    lines = "<br>".join(f"<code>{line}</code>" for line in entry.commands)
    picture = (out / entry.picture.name).read_bytes()
    return f"<h2>{entry.title}</h2><p>{lines}</p>" + inline_figure(picture, "jpeg", entry.caption)


def main(
    out: Annotated[Path, typer.Argument(help="Folder for results and gallery.html.")],
    demo: Annotated[Path, typer.Option(help="Folder of a finished `mrbokeh demo`.")] = Path("demo_out"),
    only: Annotated[str, typer.Option(help="Names of pictures, with commas between; empty for all.")] = "",
    update: Annotated[bool, typer.Option("--update", help="Copy the pictures to docs/pictures.")] = False,
) -> None:
    """Run the examples of docs/examples.md and show what they made."""
    with mistakes_told():
        entries = read_entries(EXAMPLES.read_text(encoding="utf-8"))
        chosen = [entry for entry in entries if not only or entry.picture.stem in only.split(",")]
        build(out, chosen, demo)
    if update:
        for entry in chosen:
            shutil.copyfile(out / entry.picture.name, EXAMPLES.parent / entry.picture)
    typer.echo(f"wrote {out / 'gallery.html'}")


if __name__ == "__main__":
    typer.run(main)
