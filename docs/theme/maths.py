"""Formulas become MathML when the site is built: no script, and nothing to load."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.S)
_NUMBER = re.compile(r"\\tag\{(\w+)\}")
_FUNCTION = "<mi>(?:sin|cos|tan|log|min|max)</mi>"
# The converter leaves the spaces around these to the browser, which takes bars and slashes for
# relations, a sign after an equals sign for a difference, and names of functions for variables.
_SPACES = (
    (
        re.compile(r"<mo([^>]*)>(&#x0007C;|\||&#x0002F;)</mo>"),
        r'<mo lspace="0" rspace="0"\1>\2</mo>',
    ),
    (re.compile("(<mo>&#x0003D;</mo>)<mo>&#x02212;</mo>"), r'\1<mo form="prefix">&#x02212;</mo>'),
    (re.compile(f"(?<=</mi>|</mo>)({_FUNCTION})"), r'<mspace width="0.17em"/>\1'),
    (re.compile(f"({_FUNCTION})(?=<m[in]>)"), r'\1<mspace width="0.17em"/>'),
)


def on_page_content(content: str, *, page: Any, config: Any, files: Any) -> str:
    """Replace what the Markdown extension marked as TeX."""
    return _FORMULA.sub(_mathml, content)


def _mathml(match: re.Match[str]) -> str:
    tex = html.unescape(match[2]).strip()
    if match[1] == "span":
        return _spaced(convert(tex))
    number = _NUMBER.search(tex)
    formula = _spaced(convert(_NUMBER.sub("", tex), display="block"))
    return f'<div class="formula">{formula}{f"({number[1]})" if number else ""}</div>'


def _spaced(formula: str) -> str:
    for pattern, replacement in _SPACES:
        formula = pattern.sub(replacement, formula)
    return formula
