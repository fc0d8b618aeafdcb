"""The report of a comparison: one HTML file with text, tables and pictures in it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template

from loam_gtsam.types import OutputError

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #22303c; background: #fff;
       max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #d7dde2;
         white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
td:first-child { white-space: normal; overflow-wrap: anywhere; min-width: 8rem; }
th { white-space: normal; vertical-align: bottom; }
td.best { font-weight: 700; }
td.text { text-align: left; white-space: normal; }
tr.group td { text-align: left; white-space: normal; color: #5c6b77; padding-top: 1rem; }
dt { font-weight: 600; } dd { margin: 0 0 .5rem 0; }
img { max-width: 100%; height: auto; }
.note { color: #5c6b77; }
</style>
</head>
<body>
<h1>$title</h1>
$intro
$body
</body>
</html>
""")
_BEST, _TEXT = ' class="best"', ' class="text"'
_LONG = 16  # letters of a cell that may be broken


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table of texts, for the terminal and for the report.

    ``best`` are (row, column) of the cells to point out; column 0 is the name of the row.
    ``sections`` are lines of text above some rows, by the number of the row.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    best: frozenset[tuple[int, int]] = frozenset()
    sections: Mapping[int, str] = field(default_factory=dict)


def page(title: str, intro: Sequence[str], sections: Mapping[str, str]) -> str:
    """The page as text, with paragraphs at the top.

    ``sections`` are heading -> HTML of its content. Only this HTML is not escaped.
    """
    return _PAGE.substitute(
        title=escape(title),
        intro="\n".join(f'<p class="note">{escape(text)}</p>' for text in intro),
        body="\n".join(f"<h2>{escape(name)}</h2>\n{html}" for name, html in sections.items()),
    )


def table_html(table: TextTable) -> str:
    """A table, its best cells in bold type; long texts may go over several lines."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.header)
    lines = []
    for number, row in enumerate(table.rows):
        if number in table.sections:
            text = escape(table.sections[number])
            span = len(table.header)
            lines.append(f'<tr class="group"><td colspan="{span}">{text}</td></tr>')
        best = (_BEST if (number, column) in table.best else "" for column in range(len(row)))
        styles = [_TEXT if len(cell) > _LONG else s for s, cell in zip(best, row, strict=True)]
        cells = (f"<td{s}>{escape(cell)}</td>" for s, cell in zip(styles, row, strict=True))
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f"<table><thead><tr>{head}</tr></thead>\n<tbody>{''.join(lines)}</tbody></table>"


def picture_html(caption: str, file: Path) -> str:
    """A PNG file, embedded in the page; OutputError if the file cannot be read."""
    try:
        data = base64.b64encode(file.read_bytes()).decode("ascii")
    except OSError as error:
        raise OutputError(f"{file}: cannot read the picture for the report: {error}") from error
    return f'<img alt="{escape(caption)}" src="data:image/png;base64,{data}">'


def list_html(entries: Mapping[str, str]) -> str:
    """A list of names and what they stand for."""
    lines = (f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in entries.items())
    return f"<dl>{''.join(lines)}</dl>"
