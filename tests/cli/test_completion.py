"""What the shell offers after TAB."""

import pytest
from typer.testing import CliRunner

from loam_gtsam.cli import app


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("run --sensor os1-1", ["os1-16", "os1-128"]),
        ("run --set solver.method=l", ["solver.method=loam"]),
        ("config --preset a", ["aloam"]),
        ("compare drive.bag --solver a", ["aloam"]),
        ("compare drive.bag --preset l", ["loam"]),
        ("compare drive.bag --peer kis", ["kiss-icp"]),
        ("demo --scene stair", ["stairwell"]),
        ("demo --scene nothing", []),
    ],
)
def test_the_shell_completes_values(words: str, offered: list[str]) -> None:
    line = f"loam-gtsam {words}"
    asked = {
        "_LOAM_GTSAM_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split()) - 1),
    }
    done = CliRunner().invoke(app.app, [], env=asked, prog_name="loam-gtsam")
    assert done.output.split() == offered
