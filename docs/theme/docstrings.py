"""Docstrings as this project writes them, for the API reference.

After ``name :`` stands what a value means, with shape and unit; its type is in the annotation.
Cross-references are those of Sphinx. Both are put as the site's tools want them.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

import loam_gtsam

_HEADING = re.compile(r"^(\w[\w ]*)\n-{3,}$", re.M)
_ITEM = re.compile(r"^(?P<names>\*{0,2}\w+(?:, \*{0,2}\w+)*) : (?P<text>.*(?:\n    .*)*)", re.M)
_ROLE = re.compile(r":(?:func|class|meth|mod|data|attr|exc):`~?([\w.]+)`")


class ProjectDocstrings(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """See the module."""
        if obj.docstring is not None:
            obj.docstring.value = rewritten(obj.docstring.value)


def rewritten(text: str) -> str:
    """The docstring for griffe's parser."""
    text = _ROLE.sub(lambda match: _reference(match[1]), text)
    start, *sections = _HEADING.split(text)
    for heading, body in zip(sections[::2], sections[1::2], strict=True):
        if heading in ("Parameters", "Attributes"):
            body = _ITEM.sub(_items, body)
        elif heading == "Returns" and not re.search(r"^    ", body, re.M):
            body = "\n:\n" + re.sub(r"^(?=\S)", "    ", body.lstrip("\n"), flags=re.M)
        start += f"{heading}\n{'-' * len(heading)}{body}"
    return start


def _items(match: re.Match[str]) -> str:
    """What is said of several names, for each of them."""
    return "\n".join(f"{name}\n    {match['text']}" for name in match["names"].split(", "))


def _reference(target: str) -> str:
    """A link if it is public, else the name."""
    name = target.rpartition(".")[2]
    return f"[`{name}`][loam_gtsam.{name}]" if name in loam_gtsam.__all__ else f"`{name}`"
