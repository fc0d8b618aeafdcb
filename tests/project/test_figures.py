"""The command that makes the README's pictures."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from support.quick import begin_quickly

ROOT = Path(__file__).resolve().parents[2]
image = pytest.importorskip("matplotlib.image")


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    spec = importlib.util.spec_from_file_location("figures", ROOT / "docs/figures/readme.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_one_command_makes_every_picture_of_the_readme(
    figures: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin_quickly(monkeypatch)
    assert figures.main(["--frames", "4", "--output", str(tmp_path)]) == 0
    made = {path.name for path in tmp_path.iterdir()}
    assert all(image.imread(tmp_path / name).std() > 0.02 for name in made)
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    text = "".join(page.read_text("utf-8") for page in pages)
    shown = set(re.findall(r"\]\((?:docs/)?images/([\w.]+)\)", text)) & set(figures.PICTURES)
    assert shown == made == set(figures.PICTURES)
    for name in shown:
        most = 3_000_000 if name.endswith(".webp") else 400_000
        assert (ROOT / "docs/images" / name).stat().st_size < most
