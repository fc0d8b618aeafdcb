"""The page of all parameters, made from the configuration itself."""

from __future__ import annotations

import dataclasses
from typing import Any

from mkdocs.structure.files import File, Files

from loam_gtsam import Config, preset

_INTRO = """# Parameters

Every number of the estimator, as `loam-gtsam config` prints them. Values in the columns `loam` and
`aloam` are those of these presets where they differ from the default.
"""


def on_files(files: Files, *, config: Any) -> Files:
    """Add the page."""
    files.append(File.generated(config, "parameters.md", content=text()))
    return files


def text() -> str:
    """The page as Markdown."""
    parts = [_INTRO]
    default = Config()
    for section in dataclasses.fields(default):
        name, values = section.name, getattr(default, section.name)
        parts.append(f"## {name}\n\n{section.metadata['doc'].capitalize()}.\n")
        parts.append("| key | default | `loam` | `aloam` | meaning |\n|---|---|---|---|---|")
        for item in dataclasses.fields(values):
            own = getattr(values, item.name)
            others = (getattr(getattr(preset(p), name), item.name) for p in ("loam", "aloam"))
            columns = ["" if other == own else shown(other) for other in others]
            meta = item.metadata
            unit = f" [{meta['unit']}]" if meta["unit"] else ""
            source = f" ({meta['source']})" if meta["source"] else ""
            meaning = f"{meta['doc']}{unit}{source}".replace("|", "\\|")
            parts.append(
                f"| `{name}.{item.name}` | {shown(own)} | {columns[0]} | {columns[1]} | {meaning} |"
            )
        parts.append("")
    return "\n".join(parts)


def shown(value: Any) -> str:
    """A value as the pages write it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return " x ".join(shown(entry) for entry in value)
    return f"{value:g}" if isinstance(value, float) else str(value).lower()
