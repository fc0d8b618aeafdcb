"""Results that took long to compute are written, if not where they are wanted, then elsewhere."""

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
