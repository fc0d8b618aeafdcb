"""The README and the docs say what is so: commands, links, pictures, code, keys."""

from __future__ import annotations

import importlib
import pydoc
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from support import walk
from support.quick import begin_quickly

from loam_gtsam import Config
from loam_gtsam.cli.app import app
from loam_gtsam.cli.results import PLOT_FILES, TRUTH_FILE
from loam_gtsam.io.run_files import RUN_FILES, stage_seconds, write_npz
from loam_gtsam.types import FrameStatus
from loam_gtsam.view import plots

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_ci_runs_what_the_readme_says() -> None:
    script = (ROOT / ".ci/run").read_text("utf-8").replace("--quiet ", "")
    commands = (
        "".join(text for _, text in walk.blocks(ROOT / "README.md", "bash"))
        .replace("&&", "\n")
        .splitlines()
    )
    wanted = [line.strip() for line in commands if line.startswith(("pip", "loam", "python -m"))]
    assert len(wanted) == 4
    assert [command for command in wanted if f"step {command}" not in script] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_pictures_are_there(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?://", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in anchors(file), f"{page.name}: {target}"


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as the usual Markdown hosts make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.M)
    return {
        re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings
    }


def test_every_page_is_on_the_map() -> None:
    index = ROOT / "docs/index.md"
    linked = {
        (index.parent / target.partition("#")[0]).resolve()
        for target in re.findall(r"\]\(([^)\s]+)\)", index.read_text("utf-8"))
    }
    pages = {page for page in PAGES if page != index}
    assert pages <= linked, pages - linked


IMPORT = re.compile(r"^from (loam_gtsam[\w.]*) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("page", [*PAGES, *EXAMPLES], ids=lambda page: page.name)
def test_what_the_documentation_imports_is_there_and_public(page: Path) -> None:
    for module, several, one in IMPORT.findall(page.read_text("utf-8")):
        for name in re.findall(r"\w+", several or one):
            assert not name.startswith("_")
            found = importlib.import_module(module)
            assert hasattr(found, name) or importlib.import_module(f"{module}.{name}")


PUBLIC = ("config", "datasets", "factors", "geometry", "pipeline", "studies", "types", "view")


@pytest.mark.parametrize("page", [*PAGES, *EXAMPLES], ids=lambda page: page.name)
def test_what_the_documentation_imports_does_not_change_without_a_word(page: Path) -> None:
    api = "".join(file.read_text("utf-8") for file in (ROOT / "docs/api").glob("*.md"))
    listed = set(re.findall(r"^::: loam_gtsam\.(?:\w+\.)*(\w+)$", api, re.M))
    for module, several, one in IMPORT.findall(page.read_text("utf-8")):
        if module != "loam_gtsam" and module.split(".")[1] not in PUBLIC:
            assert set(re.findall(r"\w+", several or one)) <= listed, module


WALKED = [page for page in PAGES if any(block.runs for block in walk.blocks(page, *walk.RUN))]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    walk.write_drive(folder)
    return folder


@pytest.mark.parametrize("page", WALKED, ids=lambda page: page.stem)
def test_pages_are_walked_from_top_to_bottom(
    page: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(data, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    if page.stem != "quickstart":  # the time that pictures take
        monkeypatch.setattr(plots, "available", lambda: False)
    if page.stem not in ("quickstart", "README"):  # and the start of each run
        begin_quickly(monkeypatch)
    names = walk.walk(page, (ROOT / ".ci/run").read_text("utf-8").replace("--quiet ", ""))
    if "update" in names:
        assert names["update"].status == "ok"
    if "planes" in names:
        assert len(names["planes"]) > 1000


def test_blocks_that_are_not_run_say_what_they_need() -> None:
    languages = {block.language for page in PAGES for block in walk.blocks(page)}
    assert languages <= {*walk.RUN, "text", "yaml"}
    waiting = [b for page in PAGES for b in walk.blocks(page, *walk.RUN) if not b.runs]
    assert len(waiting) < 0.3 * sum(len(walk.blocks(page, *walk.RUN)) for page in PAGES)


NOT_RUN = [
    (page, line.strip())
    for page in PAGES
    for block in walk.blocks(page, "console")
    for line in block.text.splitlines()
    if not block.runs and line.startswith("loam-gtsam ")
]


@pytest.mark.parametrize(("page", "line"), NOT_RUN, ids=[line for _, line in NOT_RUN])
def test_commands_that_are_not_run_parse(page: Path, line: str) -> None:
    _, name, *words = shlex.split(line, comments=True)
    group: Any = typer.main.get_command(app)
    command = group.commands[name]  # an unknown command is a KeyError
    command.make_context(name, list(words))  # an unknown option is a usage error
    for entry in (words[n + 1] for n, word in enumerate(words) if word == "--set"):
        section, _, field = entry.partition("=")[0].partition(".")
        assert hasattr(getattr(Config(), section), field)


def test_parameters_named_in_the_docs_exist() -> None:
    config = Config()
    named = re.compile(rf"(?<!\[)`(?:--set )?({'|'.join(Config.__annotations__)})\.([a-z]\w+)")
    found = 0
    for page in PAGES:
        for section, field in named.findall(page.read_text("utf-8")):
            if field in ("py", "ply", "png", "csv", "tum", "g2o", "lgmap", "json"):  # a file
                continue
            found += 1
            assert hasattr(getattr(config, section), field), f"{page.name}: {section}.{field}"
    assert found > 20


def test_outputs_page_lists_every_file_and_key(tmp_path: Path) -> None:
    text = (ROOT / "docs/outputs.md").read_text("utf-8")
    write_npz(tmp_path / "run.npz", [])
    with np.load(tmp_path / "run.npz") as arrays:
        keys = set(arrays.files)
    for name in (*RUN_FILES, *PLOT_FILES, TRUTH_FILE, *keys):
        assert f"`{name}`" in text, name


def test_names_in_the_table_of_other_names_are_there() -> None:
    _, page = (ROOT / "docs/index.md").read_text("utf-8").split("## Known by another name")
    cells = [line.split("|")[3] for line in page.split("\n## ")[0].splitlines() if "|" in line]
    names = re.findall(r"`([A-Za-z_][\w.]+)(?:[(:][^`]*)?`", " ".join(cells))
    assert len(names) > 20
    for name in names:
        section, _, key = name.removeprefix("loam_gtsam.").partition(".")
        known = pydoc.locate(name) or pydoc.locate(f"loam_gtsam.{name}")
        assert known is not None or hasattr(getattr(Config(), section), key), name


def test_every_status_is_explained() -> None:
    text = (ROOT / "docs/conventions.md").read_text("utf-8")
    for status in FrameStatus:
        assert f"| `{status}` |" in text


def test_every_stage_is_explained() -> None:
    from loam_gtsam import SimulatedWorld, run

    names, _ = stage_seconds(run(SimulatedWorld("room", frames=2, columns=300)).updates)
    text = (ROOT / "docs/profile.md").read_text("utf-8")
    assert [name for name in names if f"| `{name}` |" not in text] == []
