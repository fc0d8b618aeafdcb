"""Links that leave docs/, for the site.

The pages link to files of the repository by relative paths, which work wherever the repository is
shown. On the site every such file gets a page of its own, and a link whose text is the name of a
class, function or constant of that file leads to its line: ``[`matching.associate`](../../x.py)``.
A title after the path narrows it down to the first line there that has those words. A link to a CSV
file, alone on its line and with the title "table", becomes that table.
"""

from __future__ import annotations

import ast
import csv
import html
import logging
import posixpath
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PAGES = {"README.md": "overview.md", "CHANGELOG.md": "changelog.md"}
"""Pages of the repository that stand in the navigation."""
WIDE = ("from_loam.md", "maths/deviations.md", "parameters.md")
"""Pages of wide tables, which get the room of the table of contents."""
LINK = re.compile(r"(?P<text>\[[^\]]*\]\()(?P<path>[^)\s#]+)(?P<rest>[^)]*\))")
SYMBOL = re.compile(
    r'<a href="[./]*/source/(?P<path>[^"#]+\.py)/"(?: title="(?P<words>[^"]*)")?>'
    r"<code>(?P<name>\w+(?:\.(?!py<)\w+)+)</code></a>"
)
NOTEBOOK_LINK = re.compile(r'href="([\w./]+\.(?:md|ipynb))')
TABLE = re.compile(r'^\[[^\]]*\]\((?P<path>[^)\s]+\.csv) "table"\)$', re.M)
BLOCK = re.compile(r"(^```.*?^```)", re.M | re.S)
_LANGUAGES = {".py": "python", ".yml": "yaml", ".cff": "yaml", ".toml": "toml"}

log = logging.getLogger("mkdocs.hooks.links")


def line_of(source: str, name: str, words: str = "") -> int:
    """The line of a definition in a module, counted from 1.

    Parameters
    ----------
    source : of the module
    name : ``symbol`` or ``Class.method``, with the module's own name before it or not
    words : the first line of the definition that has them, instead of its own

    Raises
    ------
    LookupError
        If the module has no such name, or the definition no such words.
    """
    parts = name.split(".")
    body: list[Any] = ast.parse(source).body
    found = _defined(body, parts) or _defined(body, parts[1:])
    if found is None:
        raise LookupError(f"no {name!r}")
    first, last = found.lineno, found.end_lineno
    if not words:
        return first
    for number, line in enumerate(source.splitlines()[first - 1 : last], first):
        if words in line:
            return number
    raise LookupError(f"no {words!r} in {name!r}")


def _defined(body: list[Any], parts: list[str]) -> Any:
    found = None
    for part in parts:
        found = next((node for node in body if part in _names(node)), None)
        body = getattr(found, "body", [])
    return found


def _names(node: Any) -> list[str]:
    targets = getattr(node, "targets", [getattr(node, "target", None)])
    return [getattr(node, "name", "")] + [getattr(target, "id", "") for target in targets]


def page_of(path: str) -> str:
    """Where a file or folder of the repository is on the site."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if (ROOT / path).is_dir():
        return f"{path}.md"  # a page in docs/ lists what is in it
    return PAGES.get(path, f"source/{path}.md")


def _targets(path: str) -> set[str]:
    """Files of the repository, outside docs/, that a page links to."""
    text = with_tables(BLOCK.sub("", (ROOT / path).read_text("utf-8")), path)
    found = {_joined(path, match["path"]) for match in LINK.finditer(text) if _local(match["path"])}
    return {target for target in found if not target.startswith("docs/")}


def with_tables(markdown: str, path: str) -> str:
    """The text of a page with its tables in it."""

    def table(match: re.Match[str]) -> str:
        with (ROOT / _joined(path, match["path"])).open(encoding="utf-8", newline="") as file:
            header, *rows = csv.reader(file)
        lines = [header, ["---"] * len(header), *rows]
        return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)

    return TABLE.sub(table, markdown)


def _local(target: str) -> bool:
    return re.match(r"\w+:", target) is None


def _joined(page: str, target: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), target))


def on_files(files: Any, *, config: Any) -> Any:
    """Add the files that pages link to."""
    from mkdocs.structure.files import File

    docs = [f"docs/{page.src_uri}" for page in files.documentation_pages()]
    wanted = set(PAGES).union(*(_targets(page) for page in [*docs, *PAGES] if page.endswith(".md")))
    for path in sorted(wanted):
        if not (ROOT / path).is_file():
            continue  # a folder; a file that is missing is reported where it is linked
        text = (ROOT / path).read_text("utf-8")
        if path not in PAGES:
            language = _LANGUAGES.get(Path(path).suffix, "text")
            text = (
                f"---\ntitle: {path}\nsearch:\n  exclude: true\n---\n"
                f"# {path}\n\n````{{.{language} linenums=1}}\n{text.rstrip()}\n````\n"
            )
        files.append(File.generated(config, page_of(path), content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:
    """Point the links that leave docs/ at the pages of the files."""
    uri = page.file.src_uri
    if uri in WIDE:
        page.meta["hide"] = ["toc"]
    if uri.startswith("source/"):
        return markdown
    path = next((file for file, own in PAGES.items() if own == uri), f"docs/{uri}")

    def moved(match: re.Match[str]) -> str:
        target = _joined(path, match["path"])
        if not _local(match["path"]) or (path.startswith("docs/") and target.startswith("docs/")):
            return match[0]
        link = posixpath.relpath(page_of(target), posixpath.dirname(uri) or ".")
        return f"{match['text']}{link}{match['rest']}"

    parts = BLOCK.split(with_tables(markdown, path))
    parts[::2] = [LINK.sub(moved, part) for part in parts[::2]]
    return "".join(parts)


def on_page_content(content: str, *, page: Any, config: Any, files: Any) -> str:
    """Add the lines, and point the links of notebooks at pages, which MkDocs does not do."""
    uri = page.file.src_uri

    def with_line(match: re.Match[str]) -> str:
        path, words = match["path"], html.unescape(match["words"] or "")
        try:
            line = line_of((ROOT / path).read_text("utf-8"), match["name"], words)
        except LookupError as error:
            log.warning("%s: link to %s: %s", uri, path, error)
            return match[0]
        return match[0].replace(f'{path}/"', f'{path}/#__codelineno-0-{line}"')

    def of_notebook(match: re.Match[str]) -> str:
        file = files.get_file_from_path(_joined(uri, match[1]))
        if file is None:
            log.warning("%s: no page %s", uri, match[1])
            return match[0]
        return f'href="{file.url_relative_to(page.file)}'

    content = SYMBOL.sub(with_line, content)
    return NOTEBOOK_LINK.sub(of_notebook, content) if uri.endswith(".ipynb") else content
