"""The list of public names: kept up to date, told in the changelog, and all that the docs use."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMMAND = "python docs/public_api.py"
LOG = """# Changelog

## [0.2.0] - unreleased

### Changed

- `Mapper.register` takes `weight`; `Mapper.forget`, `--loud` and `map.cube_size` are gone.
- `Walls` are found.

## [0.1.0]

- `skip` and `map.window`, long ago.
"""


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("public_api", ROOT / "docs" / "public_api.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def listed() -> list[str]:
    return (ROOT / "docs" / "public_api.txt").read_text("utf-8").splitlines()


def test_public_names_change_with_their_list_and_the_changelog(
    tool: ModuleType, listed: list[str]
) -> None:
    now = tool.public_api()
    new, gone = [line for line in now if line not in listed], [x for x in listed if x not in now]
    missing = tool.untold(listed, now, (ROOT / "CHANGELOG.md").read_text("utf-8"))
    told = "\n".join(missing) or "CHANGELOG.md tells of them."
    assert now == listed, (
        f"public names changed; if that is wanted, run: {COMMAND}\nnew: {new}\ngone: {gone}\n{told}"
    )


# -- that the test above can fail ------------------------------------------------------------------

BEFORE = ["loam_gtsam.Mapper(config)", "loam_gtsam.Mapper.register(features)",
          "loam_gtsam.Mapper.skip(stamp)", "loam_gtsam.Mapper.forget()",
          "config map.cube_size = 50.0", "config map.window = (21, 21, 11)",
          "loam-gtsam run --loud", "loam-gtsam run --quiet/-q", "file map.ply"]  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("Mapper.register(features)", "loam_gtsam.Mapper.register(features, weight)", ""),
        ("Mapper.skip(stamp)", "loam_gtsam.Mapper.skip(stamp, why)", "changed: .*must name skip"),
        ("Mapper.forget()", "", ""),
        ("Mapper.skip(stamp)", "", "gone: loam_gtsam.Mapper.skip; .*must name skip"),
        ("", "loam_gtsam.Mapper.paint()", ""),  # what it belongs to is named
        ("", "loam_gtsam.Walls", ""),
        ("", "loam_gtsam.Roofs(slope)", "new: loam_gtsam.Roofs; .*must name Roofs"),
        ("", "loam_gtsam.Roofs.tile()", "new: .*must name Roofs or tile"),
        ("", "loam_gtsam.Walls\nloam_gtsam.Walls.paint()", ""),
        ("", "loam_gtsam.Roofs\nloam_gtsam.Roofs.tile()", "new: loam_gtsam.Roofs; "),
        ("", "loam-gtsam fly\nloam-gtsam fly --high", "new: loam-gtsam fly; .*must name fly$"),
        ("map.cube_size = 50.0", "config map.cube_size = 25.0", ""),
        ("map.window = (21, 21, 11)", "config map.window = (9, 9, 9)", "changed: .*window"),
        ("", "config solver.pace = 3", "new: config solver.pace; .*must name pace"),
        ("run --loud", "", ""),
        ("run --quiet/-q", "", "gone: loam-gtsam run --quiet/-q; .*must name --quiet or -q"),
        ("", "loam-gtsam run --slow", "new: .*must name --slow"),
        ("file map.ply", "", "gone: file map.ply"),
        ("", "file map.ply height", "new: .*must name height"),
    ],
)
def test_a_change_is_to_be_told(tool: ModuleType, old: str, new: str, sentence: str) -> None:
    after = [line for line in BEFORE if not (old and line.endswith(old))]
    assert len(after) == len(BEFORE) - bool(old)
    sentences = tool.untold(BEFORE, [*after, *new.splitlines()], LOG)
    assert len(sentences) == bool(sentence), sentences
    assert re.match(sentence, "".join(sentences))


def test_the_command_writes_what_is_told_and_nothing_else(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tool, "LIST", tmp_path / "public_api.txt")
    monkeypatch.setattr(tool, "CHANGELOG", tmp_path / "CHANGELOG.md")
    monkeypatch.setattr(tool, "public_api", lambda: BEFORE)
    tool.main()  # the first list needs no changelog
    (tmp_path / "CHANGELOG.md").write_text(LOG, encoding="utf-8")
    changed = [line.replace("skip(stamp)", "skip(stamp, why)") for line in BEFORE]
    monkeypatch.setattr(tool, "public_api", lambda: changed)
    with pytest.raises(SystemExit, match=r"changed: loam_gtsam\.Mapper\.skip"):
        tool.main()
    assert tool.LIST.read_text("utf-8").splitlines() == BEFORE
    told = LOG.replace("are found", "are found, `Mapper.skip` says why")
    (tmp_path / "CHANGELOG.md").write_text(told, encoding="utf-8")
    tool.main()
    assert tool.LIST.read_text("utf-8").splitlines() == changed


# -- the documentation -----------------------------------------------------------------------------


def test_the_page_names_every_public_module(tool: ModuleType) -> None:
    page = (ROOT / "docs" / "api_stability.md").read_text("utf-8")
    assert [name for name in tool.MODULES if f"`{name}`" not in page] == []
    assert COMMAND in page


PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md"]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
IMPORT = re.compile(r"^from (loam_gtsam[\w.]*) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)


@pytest.mark.parametrize("path", [*PAGES, *EXAMPLES], ids=lambda path: path.name)
def test_what_the_documentation_imports_is_public(
    tool: ModuleType, listed: list[str], path: Path
) -> None:
    text = path.read_text("utf-8")
    known = {re.split(r"\(| = ", line, maxsplit=1)[0] for line in listed}
    known |= {f"loam_gtsam.{module}" for module in tool.MODULES}
    for module, one, more in IMPORT.findall(text):
        for name in re.findall(r"\w+", one or more):
            # Where a name of the package itself is defined does not matter.
            assert {f"{module}.{name}", f"loam_gtsam.{name}"} & known, f"{module}.{name}"
