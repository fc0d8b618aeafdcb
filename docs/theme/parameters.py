"""The page of all parameters, made from the configuration itself."""

from __future__ import annotations

from typing import Any

from mkdocs.structure.files import File, Files

from loam_gtsam import Config, preset
from loam_gtsam.config import meaning

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
    for name, section in Config.model_fields.items():
        values = getattr(default, name)
        parts.append(f"## {name}\n\n{meaning(section)}\n")
        parts.append("| key | default | `loam` | `aloam` | meaning |\n|---|---|---|---|---|")
        for key, field in type(values).model_fields.items():
            own = getattr(values, key)
            others = (getattr(getattr(preset(p), name), key) for p in ("loam", "aloam"))
            columns = ["" if other == own else shown(other) for other in others]
            explained = meaning(field).replace("|", "\\|")
            parts.append(
                f"| `{name}.{key}` | {shown(own)} | {columns[0]} | {columns[1]} | {explained} |"
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
