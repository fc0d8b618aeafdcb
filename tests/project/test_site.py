"""The documentation as a site, its API reference, and the notebook."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import loam_gtsam

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "docs/notebooks/first_map.ipynb"
API = sorted((ROOT / "docs/api").glob("*.md"))


def test_every_public_name_is_in_the_api_reference_once() -> None:
    named = [
        name
        for page in API
        for name in re.findall(r"^::: loam_gtsam\.(\w+)$", page.read_text("utf-8"), re.M)
    ]
    assert sorted(named) == sorted(loam_gtsam.__all__)


def test_the_notebook_is_kept_without_outputs() -> None:
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)


def test_the_notebook_runs_and_says_what_it_promises() -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    pytest.importorskip("matplotlib")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    said = {
        cell["id"]: "".join(output.get("text", "") for output in cell.outputs)
        for cell in notebook.cells
        if cell.cell_type == "code"
    }
    drawn = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert sum("image/png" in output.get("data", ()) for output in drawn) == 3
    inside = re.match(r"(\d+) %", said["covariance"])
    assert inside is not None
    assert int(inside[1]) > 80
    assert "degenerate" in said["blind"]
    alone, helped = (float(text) for text in re.findall(r": ([\d.]+) m off", said["factor"]))
    assert alone > 3.0
    assert helped < 0.05 * alone


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; the notebook is not executed a second time."""
    for module in ("material", "mkdocstrings", "mkdocs_jupyter", "latex2mathml"):
        pytest.importorskip(module)
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"SITE_EXECUTES": "false", "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_public_name_has_an_anchor(site: Path) -> None:
    pages = "".join((site / "api" / page.stem / "index.html").read_text("utf-8") for page in API)
    assert [n for n in loam_gtsam.__all__ if f'id="loam_gtsam.{n}"' not in pages] == []


def test_docstrings_are_read_as_they_are_meant(site: Path) -> None:
    page = (site / "api/types/index.html").read_text("utf-8")
    row = page[page.index(">plane_times</span></code></td>") :].partition("</tr>")[0]
    assert "FloatArray" in row  # the annotation is the type
    assert "seconds from" in row  # and what stands behind the colon says what it is
    for path in (site / "api").rglob("*.html"):
        assert re.search(r":(func|class|meth|attr|mod):|``", path.read_text("utf-8")) is None, path


def test_formulas_are_drawn_without_scripts(site: Path) -> None:
    for source in sorted((ROOT / "docs/maths").glob("*.md")):
        page = (site / "maths" / source.stem / "index.html").read_text("utf-8")
        assert page.count("<math") >= source.read_text("utf-8").count("$$") // 2
        assert "arithmatex" not in page, source.name
        assert "\\frac" not in page, source.name


def test_lines_that_are_linked_to_are_there(site: Path) -> None:
    page = (site / "from_loam/index.html").read_text("utf-8")
    links = set(re.findall(r'href="\.\./(source/[^"#]+)#([^"]+)"', page))
    assert len(links) > 80
    pages = {path: (site / path / "index.html").read_text("utf-8") for path, _ in links}
    assert [link for link in links if f'id="{link[1]}"' not in pages[link[0]]] == []


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    loaded = re.compile(r'<(?:script|img|iframe)[^>]*src="(?:https?:)?//|<link[^>]*href="https?://')
    for page in site.rglob("*.html"):
        assert loaded.search(page.read_text("utf-8")) is None, page
