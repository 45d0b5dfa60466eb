"""HTML pages in one file: sections, tables, pictures and charts inline, so that a page can be sent and read anywhere."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from mrbokeh.system.atomic_files import atomic_path

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 78rem; padding: 0 1rem; color: #222; background: #fff; }
h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc; } h3 { margin: 1.5rem 0 .3rem; }
table { border-collapse: collapse; } td, th { padding: .2rem .9rem .2rem 0; text-align: left; vertical-align: top; }
td.number { text-align: right; font-variant-numeric: tabular-nums; } .wide { overflow-x: auto; }
figure { display: inline-block; margin: .5rem .8rem .5rem 0; max-width: 100%; }
figcaption { font-size: 13px; color: #555; max-width: 36rem; }
img { max-width: 100%; height: auto; border: 1px solid #ddd; } svg, canvas { max-width: 100%; height: auto; }
code { font-size: 12px; overflow-wrap: anywhere; } .muted { color: #667; }
.met { color: #1a7a2e; } .missed { color: #b00020; font-weight: bold; }
"""


def write_page(path: Path, title: str, blocks: Iterable[str], style: str = "") -> None:
    """Write an HTML page of blocks, one below the other. style: CSS in addition to STYLE."""
    head = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}{style}</style>"
    )
    page = f"{head}<body>{chr(10).join(blocks)}</body></html>\n"
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def section(title: str, text: str, blocks: Iterable[str]) -> str:
    return f"<h2>{html.escape(title)}</h2><p>{html.escape(text)}</p>" + "\n".join(blocks)


def cell(text: str, kind: str = "text") -> str:
    return f'<td class="{html.escape(kind)}">{html.escape(text)}</td>'


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of rows of cells made by `cell`; a table wider than the screen scrolls sideways."""
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(cells)}</tr>" for cells in rows)
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def inline_figure(picture: bytes, kind: str, caption: str) -> str:
    """Return a figure with the picture inside the page. picture: an encoded file. kind: jpeg or png."""
    data = base64.b64encode(picture).decode("ascii")
    text = html.escape(caption)
    return f'<figure><img src="data:image/{kind};base64,{data}" alt="{text}"><figcaption>{text}</figcaption></figure>'
