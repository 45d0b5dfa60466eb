"""Sphinx's settings for `make docs`. Its source is the whole checkout, so that links between pages are those of the forge."""

import re
from typing import Any

import mrbokeh

project, author = "mrbokeh", "the authors of mrbokeh"
version = release = mrbokeh.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md"]
myst_heading_anchors = 3
smartquotes = False  # options begin with two hyphens
html_theme = "furo"
html_title = "mrbokeh"
html_static_path = ["site"]
html_css_files = ["site.css"]
html_show_sourcelink = html_show_copyright = False
default_role = "code"
autodoc_typehints = "description"
autodoc_typehints_format = "short"


def as_fields(_app: Any, _what: str, _name: str, obj: Any, _options: Any, lines: list[str]) -> None:
    """Turn a docstring of this project (`name: meaning`, `Raises InputError if ...`) into the fields that Sphinx lists with their types."""
    names = "|".join(getattr(obj, "__annotations__", ())) or "-"
    start = re.compile(rf"(?:^|(?<=\. ))(?=(?:{names})(?:, (?:{names}))*: |Raises \w+ )", re.MULTILINE)
    paragraphs, lines[:] = re.split(r"\n\s*\n", "\n".join(lines).strip()), []
    for paragraph in paragraphs:
        for part in filter(None, start.split(paragraph)):
            text = re.sub(r"([|*])", r"\\\1", " ".join(part.split()))
            field = re.match(rf"((?:{names})(?:, (?:{names}))*): (.*)|Raises (\w+) (.*)", text)
            if not field:
                lines += ["", text, ""]
            elif field[1]:
                lines += [f":param {each}: {field[2]}" for each in field[1].split(", ")]
            else:
                lines += [f":raises {field[3]}: {field[4]}"]
        lines.append("")


def setup(app: Any) -> None:
    """Connect what reads docstrings."""
    app.connect("autodoc-process-docstring", as_fields)
