"""The examples of docs/examples.md: what they are called, which commands make them, and the picture of the result."""

import re
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.system.errors import InputError

_ENTRY = re.compile(
    r"^## (?P<title>[^\n]+)\n(?:(?!^#).)*?```sh\n(?P<commands>.*?)```\n+!\[(?P<caption>[^\]]*)\]\((?P<picture>[^)]+)\)\n"
    r"<!-- (?P<kind>shows|page): (?P<source>[^\n]+?) -->",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True)
class Entry:
    """picture: its path from the page. Either `shows`, files that the commands make (side by side), or `page`, an address."""

    title: str
    commands: tuple[str, ...]
    caption: str
    picture: Path
    shows: str = ""
    page: str = ""


def read_entries(page: str) -> list[Entry]:
    """All examples with a picture, in order. Raises InputError where there is none."""
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
