"""Results that took long to compute are written, if not where they are wanted, then elsewhere."""

import subprocess
import sys
from pathlib import Path

import pytest

from loam_gtsam.cli.console import write_results
from loam_gtsam.types import OutputError


@pytest.fixture(autouse=True)
def _temporary_files_here(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)


@pytest.mark.parametrize("problem", ["disk full", "cannot write there"])
def test_results_that_cannot_be_written_or_moved_to_their_places_go_elsewhere(problem, tmp_path):
    def write(there):
        if problem == "disk full" and "wanted" in there.parts:
            raise OutputError(problem)
        (there / "results").write_text("all of it")
        return ["results"]

    (tmp_path / "wanted" / "results").mkdir(parents=True)  # a folder in the place of the file
    with pytest.raises(OutputError, match=rf"{problem}.* The results were written to .*instead"):
        write_results(tmp_path / "wanted", [], "results", write)
    written = [path.read_text() for path in tmp_path.glob("loam_gtsam_wanted_*/results")]
    assert written == ["all of it"]


def test_what_can_be_written_is_kept_whatever_goes_wrong(tmp_path):
    def write(there):
        (there / "results").write_text("most of it")
        raise ZeroDivisionError("a picture")

    wanted = tmp_path / "wanted"
    wanted.mkdir()
    with pytest.raises(OutputError, match=r"ZeroDivisionError\('a picture'\)\. What could be"):
        write_results(wanted, [], "results", write)
    written = [path.read_text() for path in tmp_path.glob("loam_gtsam_wanted_*/results")]
    assert written == ["most of it"]
    assert not list(wanted.iterdir())


def test_if_nothing_can_be_written_the_first_problem_is_told(tmp_path):
    def write(there):
        raise OutputError("disk full")

    with pytest.raises(OutputError, match=r"^disk full$"):
        write_results(tmp_path, [], "results", write)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a full disk at hand")
def test_a_full_disk_at_the_standard_output_is_one_sentence():
    command = [sys.executable, "-m", "loam_gtsam.cli", "config"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: standard output: ")
    assert "No space left" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    assert shown.stdout.startswith("#")
    assert shown.stderr == ""
