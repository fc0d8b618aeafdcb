"""The report of a comparison: one HTML file with text, tables and pictures in it."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template

from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.types import OutputError

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #22303c; background: #fff;
       max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #d7dde2;
         white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
td.best { font-weight: 700; }
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
_BEST = ' class="best"'


def write_report(
    path: str | Path,
    title: str,
    intro: Sequence[str],
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    best: Iterable[tuple[int, int]],
    definitions: Mapping[str, str],
    pictures: Mapping[str, Path],
    facts: Mapping[str, str],
) -> None:
    """Write the report; all texts are plain texts, which this function escapes.

    Parameters
    ----------
    intro : paragraphs at the top
    header, rows : of the table of scores
    best : (row, column) of the cells in bold type
    definitions : column name -> meaning of the column
    pictures : caption -> PNG file, which is embedded in the page
    facts : solver -> version and settings

    Raises
    ------
    OutputError
        If a picture cannot be read or the page cannot be written.
    """
    body = [
        "<h2>Scores</h2>",
        _table(header, rows, set(best)),
        *(_picture(caption, file) for caption, file in pictures.items()),
        "<h2>Definitions</h2>",
        _list(definitions),
        "<h2>What was run</h2>",
        _list(facts),
    ]
    page = _PAGE.substitute(
        title=escape(title),
        intro="\n".join(f'<p class="note">{escape(text)}</p>' for text in intro),
        body="\n".join(body),
    )
    with atomic_file(path) as file:
        file.write(page.encode("utf-8"))


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], best: set[tuple[int, int]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    lines = []
    for number, row in enumerate(rows):
        cells = "".join(
            f"<td{_BEST if (number, column) in best else ''}>{escape(cell)}</td>"
            for column, cell in enumerate(row)
        )
        lines.append(f"<tr>{cells}</tr>")
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _picture(caption: str, file: Path) -> str:
    try:
        data = base64.b64encode(file.read_bytes()).decode("ascii")
    except OSError as error:
        raise OutputError(f"{file}: cannot read the picture for the report: {error}") from error
    text = escape(caption)
    return f'<h2>{text}</h2>\n<img alt="{text}" src="data:image/png;base64,{data}">'


def _list(entries: Mapping[str, str]) -> str:
    lines = (f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in entries.items())
    return f"<dl>{''.join(lines)}</dl>"
