"""Tables as CSV files, and in Markdown."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any


def write_csv(
    path: Path, names: Sequence[str], rows: Iterable[Sequence[object]], digits: int = 6
) -> None:
    """Write rows below their names, floats with so many significant digits; makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for row in rows:
            writer.writerow([f"{v:.{digits}g}" if isinstance(v, float) else v for v in row])


def write_rows(path: Path, rows: Sequence[Any], digits: int = 4) -> None:
    """Write rows that are data classes of one kind, below the names of their fields."""
    write_csv(path, [item.name for item in fields(rows[0])], map(astuple, rows), digits)


def markdown_table(names: Sequence[str], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """The lines of a table in Markdown."""
    yield f"| {' | '.join(names)} |"
    yield "|---" * len(names) + "|"
    for row in rows:
        yield f"| {' | '.join(map(str, row))} |"
