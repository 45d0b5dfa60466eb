"""focus.csv beside the photographs: focus distances by file name, for those who measured or logged them.

    file,focus_distance_m,nearest_m,farthest_m
    IMG_0001.NEF,0.50,0.48,0.52
    IMG_0002.NEF,0.60
    IMG_0003.NEF,inf

nearest_m and farthest_m say between which distances the true one lies; without them it is taken as exact. Where
distances count from is said in lens.toml (focus_origin).
"""

import csv
from pathlib import Path

from capture.photos.stated_focus import StatedFocus
from mrbokeh.system.errors import InputError

FILE_NAME = "focus.csv"
_NEEDED = ("file", "focus_distance_m")
_COLUMNS = (*_NEEDED, "nearest_m", "farthest_m")


def read_focus_csv(path: Path) -> dict[str, StatedFocus]:
    """The distances of a focus.csv by file name. Raises InputError naming the line that is wrong."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"expected focus distances in {path}, but there is no such file") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text in UTF-8: {error}") from None
    rows = csv.DictReader(text.splitlines(), skipinitialspace=True)
    names = [name.strip() for name in rows.fieldnames or []]
    rows.fieldnames = names
    if not set(_NEEDED) <= set(names) or not set(names) <= set(_COLUMNS):
        raise InputError(f"{path}: expected a first line {','.join(_COLUMNS)} (the last two may be left out), got {','.join(names)!r}")
    result: dict[str, StatedFocus] = {}
    for row in rows:
        where = f"{path}, line {rows.line_num}"
        name = (row["file"] or "").strip()
        if not name or name in result:
            raise InputError(f"{where}: expected the name of a file that was not named before, got {name!r}")
        result[name] = StatedFocus.checked([_cell(row.get(column)) for column in _COLUMNS[1:]], where)
    return result


def _cell(text: str | None) -> str | float | None:
    """A number where it is one, else the text for the message; None for an empty cell."""
    stripped = (text or "").strip()
    try:
        return float(stripped) if stripped else None
    except ValueError:
        return stripped
