"""One version everywhere, and completion in the shells that people use."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

import loam_gtsam

ROOT = Path(__file__).resolve().parents[2]


def test_the_version_is_that_of_the_project_file_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    assert loam_gtsam.__version__ == version("loam_gtsam") == project
    for page, pattern in (
        ("CITATION.cff", r"^version: (.+)$"),
        ("README.md", r"^This is version (\S+)\.$"),
        ("CHANGELOG.md", r"^## \[(\d\S*)\]"),  # the newest comes first
    ):
        found = re.search(pattern, (ROOT / page).read_text("utf-8"), re.MULTILINE)
        assert found is not None, page
        assert found[1] == project, page


COMPLETED = [
    ("loam-gtsam ins", "inspect"),
    ("loam-gtsam run --over", "--overwrite"),
    ("loam-gtsam run --sensor vl", "vlp16"),
]


@pytest.mark.parametrize(("typed", "completed"), COMPLETED)
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_commands_and_options_complete(shell: str, typed: str, completed: str) -> None:
    command = shutil.which("loam-gtsam", path=str(Path(sys.executable).parent))
    if command is None:
        pytest.skip("the package is not installed beside this Python")
    environment = os.environ | {
        "_LOAM_GTSAM_COMPLETE": f"complete_{shell}",
        "_TYPER_COMPLETE_ARGS": typed,  # zsh
        "COMP_WORDS": typed,  # bash
        "COMP_CWORD": str(len(typed.split()) - 1),
    }
    done = subprocess.run([command], env=environment, capture_output=True, text=True, timeout=60)
    words = re.findall(r"[\w-]+", done.stdout)
    assert completed in words
    assert "--frames" not in words


def test_the_script_for_bash_works_in_bash(tmp_path: Path) -> None:
    folder = Path(sys.executable).parent
    bash = shutil.which("bash")
    if bash is None or not (folder / "loam-gtsam").exists():
        pytest.skip("no bash, or the package is not installed beside this Python")
    script = """
        eval "$(_LOAM_GTSAM_COMPLETE=source_bash loam-gtsam)"
        COMP_WORDS=(loam-gtsam comp) COMP_CWORD=1
        _loam_gtsam_completion loam-gtsam
        echo "${COMPREPLY[@]}"
    """
    path = f"{folder}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [bash, "-c", script],
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        timeout=60,
        cwd=tmp_path,
    )
    assert done.stdout.split() == ["compare"], done.stderr
