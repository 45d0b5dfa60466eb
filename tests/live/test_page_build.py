"""The built page belongs to its sources, and is all that a browser needs."""

import hashlib
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2] / "viewfinder"
SOURCES, BUILT = ROOT / "page_source", ROOT / "page"


def hash_of_sources() -> str:
    """As build.mjs makes it: name and text of each file of src and static, in order."""
    hashed = hashlib.sha256()
    for folder in ("src", "static"):
        for path in sorted((SOURCES / folder).iterdir(), key=lambda path: path.name):
            text = path.read_bytes().decode().replace("\r\n", "\n")
            hashed.update(f"{folder}/{path.name}\0{text}\0".encode())
    return hashed.hexdigest()


def test_the_built_scripts_carry_the_hash_of_their_sources() -> None:
    for name in ("viewfinder.js", "camera.js"):
        first = (BUILT / name).read_text(encoding="utf-8").splitlines()[0]
        assert re.search(r"sources: ([0-9a-f]{64})$", first), first
        assert first.endswith(hash_of_sources()), (
            f"{name} is older than its sources: run `npm ci && npm run build` in viewfinder/page_source"
        )


def test_what_is_copied_is_the_same() -> None:
    for path in (SOURCES / "static").iterdir():
        assert (BUILT / path.name).read_text(encoding="utf-8") == path.read_text(encoding="utf-8")


def test_the_page_loads_nothing_from_elsewhere() -> None:
    for path in BUILT.iterdir():
        text = path.read_text(encoding="utf-8")
        addresses = set(re.findall(r"(?:https?|wss?):(?://)[\w.-]+", text))
        assert not addresses, (path.name, addresses)


def test_every_file_that_the_page_names_is_served_to_everybody() -> None:
    from viewfinder.server.access import needed_role
    from viewfinder.server.site import PAGE

    assert {name for name, _ in PAGE.values()} == {path.name for path in BUILT.iterdir()} - {"README.md"}
    assert all(needed_role(path) is None for path in PAGE)
    for html in BUILT.glob("*.html"):
        named = re.findall(r'(?:src|href)="([^"]+)"', html.read_text(encoding="utf-8"))
        assert all(f"/{name}" in PAGE for name in named if not name.startswith("data:"))
