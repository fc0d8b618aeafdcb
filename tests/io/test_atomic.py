"""Files are whole or not there, whatever interrupts the writing."""

import errno
import fcntl
import json
import logging
import os
import signal

import numpy as np
import pytest

from loam_gtsam.io.atomic import (
    ClosingWriter,
    atomic_file,
    make_folder,
    staged_files,
    used_alone,
    write_json,
)
from loam_gtsam.types import OutputError


def break_off(block, write, error):
    with block as place:
        write(place)
        raise error


def test_an_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        break_off(atomic_file(path), lambda file: file.write(b"half"), KeyboardInterrupt())
    assert path.read_text() == "old"
    with atomic_file(path) as file:
        file.write(b"new")
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_is_a_clear_error(tmp_path):
    message = r"file: cannot write the file: No space left"
    with pytest.raises(OutputError, match=message), atomic_file(tmp_path / "file"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    for blocked in ("file", "file/below"):
        with pytest.raises(OutputError, match="cannot make this output folder"):
            make_folder(tmp_path / blocked)
    assert list(make_folder(tmp_path / "new" / "one").iterdir()) == []


def test_numbers_that_json_lacks_become_null(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"a": [np.float64("nan"), np.int64(3)], "b": (float("inf"), 0.5)})
    assert json.loads(path.read_text()) == {"a": [None, 3], "b": [None, 0.5]}


class FullDisk(ClosingWriter):
    def close(self):
        raise OutputError("disk full")


def test_what_ended_the_block_matters_more_than_an_error_of_closing():
    with pytest.raises(OutputError, match="disk full"), FullDisk():
        pass
    with pytest.raises(ZeroDivisionError), FullDisk():
        raise ZeroDivisionError


# -- files that take their places together ------------------------------------------------------


def write(folder, names, text):
    with staged_files(folder, ("a", "b", "picture", "last"), last="last") as new:
        for name in names:
            (new / name).write_text(text)


def content(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_new_files_replace_old_ones_together_and_those_of_a_killed_process(tmp_path):
    (tmp_path / "notes").write_text("mine")
    write(tmp_path, ["a", "b", "picture", "last"], "old")
    (tmp_path / ".loam_gtsam_new").mkdir()
    (tmp_path / ".loam_gtsam_new" / "picture").write_text("of the killed process")
    write(tmp_path, ["a", "b", "last"], "new")
    assert content(tmp_path) == {"notes": "mine", "a": "new", "b": "new", "last": "new"}


def test_an_error_while_writing_leaves_the_old_files(tmp_path):
    write(tmp_path, ["a", "last"], "old")
    staged = staged_files(tmp_path, ("a", "last"), last="last")
    with pytest.raises(OutputError, match="disk"):
        break_off(staged, lambda new: (new / "a").write_text("half"), OSError(28, "full disk"))
    assert content(tmp_path) == {"a": "old", "last": "old"}


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_files_whose_move_was_cut_off_are_not_taken_for_complete(moved, tmp_path, monkeypatch):
    write(tmp_path, ["a", "b", "picture", "last"], "old")
    left = [moved]

    def cut_off(source, target, replace=os.replace):
        if target.parent == tmp_path:
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
        replace(source, target)

    monkeypatch.setattr(os, "replace", cut_off)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, ["a", "b", "last"], "new")
    monkeypatch.undo()
    assert not (tmp_path / "last").exists()
    write(tmp_path, ["a", "b", "last"], "newer")
    assert content(tmp_path) == {"a": "newer", "b": "newer", "last": "newer"}


def test_a_folder_is_used_by_one_run_at_a_time_and_free_when_that_was_killed(tmp_path):
    ready, told = os.pipe()
    child = os.fork()
    if child == 0:
        with used_alone(tmp_path):
            os.write(told, b"x")
            signal.pause()
    os.read(ready, 1)
    try:
        with pytest.raises(OutputError, match="another run uses this folder"), used_alone(tmp_path):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    with used_alone(tmp_path):
        assert list(tmp_path.iterdir()) == []
    with used_alone(tmp_path):
        pass


def test_where_folders_cannot_be_locked_there_is_no_lock(tmp_path, monkeypatch, caplog):
    def flock(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with caplog.at_level(logging.INFO), used_alone(tmp_path), used_alone(tmp_path):
        assert caplog.text.count("cannot be locked: [Errno") == 2
    assert list(tmp_path.iterdir()) == []
