"""The house: sizes, layers, what is private stays private, and what is public can be imported."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import griffe
import pytest
from importlinter.cli import lint_imports

import loam_gtsam

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "loam_gtsam"
FILES = sorted(PACKAGE.rglob("*.py"))
Function = ast.FunctionDef | ast.AsyncFunctionDef

# -- sizes -----------------------------------------------------------------------------------------

LINES_OF_A_FILE, LINES_OF_A_CLASS, LINES_OF_A_FUNCTION = 480, 250, 60
FILES_OF_THE_ROOT, FILES_OF_A_FOLDER = 11, 12


def code_lines(function: Function, lines: list[str]) -> int:
    """Lines of a function without its docstring, comments and blank lines."""
    first = function.body[0]
    documented = ast.get_docstring(function) is not None
    own = [*lines[function.lineno - 1 : first.lineno - 1]]
    own += lines[(first.end_lineno or 0) if documented else first.lineno - 1 : function.end_lineno]
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in own)


def too_large(path: Path) -> Iterator[str]:
    lines = path.read_text("utf-8").splitlines()
    if len(lines) > LINES_OF_A_FILE:
        yield f"{len(lines)} lines"
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.ClassDef):
            size = (node.end_lineno or 0) - node.lineno + 1
            if size > LINES_OF_A_CLASS:
                yield f"class {node.name}: {size} lines"
        elif isinstance(node, Function) and code_lines(node, lines) > LINES_OF_A_FUNCTION:
            yield f"{node.name}(): {code_lines(node, lines)} lines of code"


def test_files_classes_and_functions_fit_on_their_pages() -> None:
    found = [f"{path.relative_to(ROOT)}: {what}" for path in FILES for what in too_large(path)]
    assert not found, "\n".join(found)


def test_folders_can_be_overlooked() -> None:
    counts = {folder: len(list(folder.glob("*.py"))) for folder in {path.parent for path in FILES}}
    assert counts.pop(PACKAGE) <= FILES_OF_THE_ROOT
    assert {str(folder): n for folder, n in counts.items() if n > FILES_OF_A_FOLDER} == {}


# -- layers and privacy ----------------------------------------------------------------------------


def test_imports_go_down_the_floors_and_never_in_circles() -> None:
    config = str(ROOT / "pyproject.toml")
    assert lint_imports(config_filename=config, no_cache=True, no_logo=True) == 0


NAMED_TUPLE = ("_replace", "_asdict", "_fields")


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def own_names(node: ast.ClassDef) -> set[str]:
    """Private names that a class defines: methods, fields, and what it assigns to itself."""
    names = {part.name for part in node.body if isinstance(part, Function)}
    for part in ast.walk(node):
        if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store):
            if ast.unparse(part.value) in ("self", "cls"):
                names.add(part.attr)
        elif isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            names.add(part.target.id)
        elif isinstance(part, ast.Assign):
            names |= {target.id for target in part.targets if isinstance(target, ast.Name)}
    return {name for name in names if is_private(name)}


def intrusions(node: ast.AST, own: frozenset[str] = frozenset()) -> Iterator[tuple[str, int]]:
    """Uses of what another object or module keeps to itself, as (what, line).

    A class may use the private names that it defines on any object, for that may be another of its
    kind.
    """
    if isinstance(node, ast.ClassDef):
        own = own | own_names(node)
    if isinstance(node, ast.ImportFrom) and node.module != "__future__":
        yield from ((alias.name, node.lineno) for alias in node.names if is_private(alias.name))
    if isinstance(node, ast.Attribute) and is_private(node.attr) and node.attr not in own:
        owner = ast.unparse(node.value)
        if owner not in ("self", "cls", "super()", "os") and node.attr not in NAMED_TUPLE:
            yield f"{owner}.{node.attr}", node.lineno
    for child in ast.iter_child_nodes(node):
        yield from intrusions(child, own)


def test_nobody_uses_what_another_object_keeps_to_itself() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {what}"
        for path in FILES
        for what, line in intrusions(ast.parse(path.read_text("utf-8")))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("self._a\ncls._b\nsuper()._c\nx.__class__\nos._exit(1)", 0),
        ("def f(x):\n    return x._a", 1),
        ("from loam_gtsam.mapper import _first", 1),
        ("class A:\n    def __init__(self, b):\n        self._a = b._c", 1),
        ("class A:\n    _a: int\n    def f(self, other: A):\n        return other._a", 0),
        ("class A:\n    def _f(self): ...\ndef g(a):\n    a._f()", 1),
    ],
)
def test_every_intrusion_is_seen(code: str, count: int) -> None:
    assert len(list(intrusions(ast.parse(code)))) == count


# -- what is public --------------------------------------------------------------------------------


def test_few_names_are_public_and_each_can_be_imported_and_says_what_it_is() -> None:
    names = loam_gtsam.__all__
    assert len(names) <= 45
    assert set(names) <= set(dir(loam_gtsam))
    things = [(name, getattr(loam_gtsam, name)) for name in names]
    callables = [(name, thing) for name, thing in things if callable(thing)]
    assert [name for name, thing in callables if not inspect.getdoc(thing)] == []


def signatures(thing: griffe.Object | griffe.Alias) -> Iterator[tuple[str, griffe.Expr]]:
    """The annotations that a user of a function or class meets, as (where, annotation)."""
    if thing.is_function:
        for parameter in thing.parameters:
            if isinstance(parameter.annotation, griffe.Expr):
                yield f"{thing.path}({parameter.name})", parameter.annotation
        if isinstance(thing.returns, griffe.Expr):
            yield f"{thing.path}()", thing.returns
    elif thing.is_attribute and isinstance(thing.annotation, griffe.Expr):
        yield thing.path, thing.annotation
    elif thing.is_class:
        for name, member in thing.members.items():
            if name == "__init__" or not name.startswith("_"):
                yield from signatures(member)


def test_every_name_in_a_public_signature_can_be_imported() -> None:
    found = griffe.GriffeLoader(search_paths=[str(ROOT)])
    package = found.load("loam_gtsam")
    found.resolve_aliases()
    hidden = set()
    for name in loam_gtsam.__all__:
        thing = package.members.get(name)
        if thing is None:  # imported when first used
            thing = found.modules_collection[getattr(loam_gtsam, name).__module__][name]
        for where, annotation in signatures(thing):
            for part in annotation.iterate():
                path = part.canonical_path if isinstance(part, griffe.ExprName) else ""
                if path.startswith("loam_gtsam.") and any(map(is_private, path.split("."))):
                    value = getattr(found.modules_collection[path], "value", None)
                    if not str(value).startswith("TypeVar"):
                        hidden.add(f"{where}: {path}")
    assert hidden == set()
