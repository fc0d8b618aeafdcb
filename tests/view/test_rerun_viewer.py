"""The viewer's recording holds what was shown; what can go wrong with it is said."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter

import numpy as np
import pytest
from support.cli import loam
from support.frames import STAMP, around, frame
from support.list_dataset import ListDataset
from support.quick import QUICK, QUICK_START

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.types import OutputError
from loam_gtsam.view.observers import watch
from loam_gtsam.view.rerun_viewer import RerunViewer
from loam_gtsam.view.rrd_file import RrdFile

gtsam = pytest.importorskip("gtsam")
# -- without Rerun -----------------------------------------------------------------------------


def test_without_rerun_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(OutputError, match=r'pip install "loam_gtsam\[viewer\]"'):
        RerunViewer(tmp_path / "run.rrd")
    done = loam(
        "run", "sim:room?frames=2", "--rrd", tmp_path / "run.rrd", "--output", tmp_path / "o"
    )
    assert done.exit_code == 1
    assert "loam_gtsam[viewer]" in done.output
    assert not (tmp_path / "run.rrd").exists()


def test_a_file_is_refused_if_its_name_is_wrong_or_taken(tmp_path):
    for name in ("run.bag", "run"):
        with pytest.raises(OutputError, match=r"ends in \.rrd"):
            RrdFile(tmp_path / name, False)
    (tmp_path / "run.rrd").write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        RrdFile(tmp_path / "run.rrd", False)
    assert (tmp_path / "run.rrd").read_text() == "mine"
    with pytest.raises(OutputError, match="cannot write"):
        RrdFile(tmp_path / "run.rrd" / "below.rrd", False)


def test_what_goes_through_the_pipe_is_in_the_file(tmp_path):
    (tmp_path / "run.rrd").write_text("an older one")
    file = RrdFile(tmp_path / "run.rrd", True)
    data = os.urandom(3_000_000)
    with open(file.sink, "wb") as sink:
        file.opened()
        sink.write(data)
    file.finish()
    assert (tmp_path / "run.rrd").read_bytes() == data


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no full disk to write to")
def test_a_full_disk_is_an_error_and_does_not_block(tmp_path):
    (tmp_path / "run.rrd").symlink_to("/dev/full")
    file = RrdFile(tmp_path / "run.rrd", True)
    with open(file.sink, "wb") as sink:
        file.opened()
        sink.write(bytes(3_000_000))
    with pytest.raises(OutputError, match="free some space"):
        file.finish()


@pytest.fixture
def chunks():
    """Read a recording: its rows by entity, its chunks, and how many blueprints it has."""
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    def read(path):
        reader = RrdReader(path)
        found = reader.stream().to_chunks()
        rows = Counter()
        for chunk in found:
            rows[chunk.entity_path] += chunk.num_rows
        return rows, found, len(reader.blueprints())

    return read


def column(found, entity, name):
    """The values of one component of an entity, a list for each row in the order of time."""
    rows = []
    for chunk in found:
        if chunk.entity_path == entity:
            batch = chunk.to_record_batch().to_pydict()
            # What no row of a chunk has is left out of it.
            values = batch.get(name, [None] * chunk.num_rows)
            rows += zip(batch["frame"], values, strict=True)
    return [values for _, values in sorted(rows, key=lambda row: row[0])]


def test_a_run_is_recorded_frame_by_frame(tmp_path, chunks):
    world = SimulatedWorld("room", frames=6, columns=450)
    path = tmp_path / "new" / "run.rrd"
    with RerunViewer(path, every=4) as viewer:
        outcome = run(ListDataset(list(world)), QUICK, observe=watch(viewer))
    rows, found, blueprints = chunks(path)
    each = ("sweep", "covariance", "features/edges", "features/planes", "matches/points",
            "matches/residuals")  # fmt: skip
    assert [rows[f"/map/{name}"] for name in each] == [6] * len(each)
    assert rows["/map/lidar"] == 6 + 1  # the size of its axes, for all times
    some = ("trajectory", "surroundings/edges", "surroundings/planes", "loops/used")
    # Frames 0 and 4, and the end.
    assert [rows[f"/map/{name}"] for name in some] == [3] * len(some)
    assert (rows["/frame/matches/planes"], rows["/frame/messages"]) == (
        7,
        1,
    )  # its style is for all times
    assert blueprints == 1
    matches = column(found, "/map/matches/points", "Points3D:positions")
    expected = [u.n_edge_matches + u.n_plane_matches for u in outcome.updates]
    assert [len(row) for row in matches] == expected
    check = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "verify", path], capture_output=True, text=True
    )
    assert check.returncode == 0, check.stderr


def test_the_first_view_is_from_behind_and_curves_of_a_plot_differ(tmp_path, chunks):
    """How it looks was judged by eye, with the viewer's own screenshots."""
    with RerunViewer(tmp_path / "run.rrd") as viewer:
        viewer.show(frame(0), around)
    _, found, _ = chunks(tmp_path / "run.rrd")
    colours = {}
    for chunk in found:
        batch = chunk.to_record_batch()
        if "SeriesLines:colors" in batch.schema.names:
            plot, _, curve = chunk.entity_path.removeprefix("/frame/").partition("/")
            colours.setdefault(plot, {})[curve] = batch.column("SeriesLines:colors")[0].as_py()[0]
    assert {plot: len(curves) for plot, curves in colours.items()} == {
        "matches": 2, "residual": 1, "sigma_mm": 3, "milliseconds": 1
    }  # fmt: skip
    for curves in colours.values():
        assert len({*curves.values()}) == len(curves)

    from rerun.chunk import RrdReader

    reader, seen = RrdReader(tmp_path / "run.rrd"), {}
    for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.startswith("EyeControls3D:"):
                seen[name.partition(":")[2]] = batch.column(name)[0].as_py()[0]
    x, y, z = seen["position"]
    assert x < 0.0 and z > 5.0 and 10.0 < np.hypot(x, y) < 20.0  # noqa: PT018
    assert seen["look_target"] == [0.0, 0.0, 0.0]
    assert seen["eye_up"] == [0.0, 0.0, 1.0]
    assert seen["tracking_entity"].strip("/") == "map/lidar"


def test_stamps_are_exact_and_numbers_are_those_of_the_frames(tmp_path, chunks):
    with RerunViewer(tmp_path / "run.rrd") as viewer:
        for number in (3, 4):
            viewer.show(frame(number), around)
    _, found, _ = chunks(tmp_path / "run.rrd")
    times = set()
    for chunk in found:
        if chunk.entity_path == "/map/sweep":
            batch = chunk.to_record_batch()
            stamps = batch.column("stamp").cast("int64").to_pylist()
            times |= set(zip(batch.column("frame").to_pylist(), stamps, strict=True))
    assert times == {(3, STAMP + 3), (4, STAMP + 4)}


def test_ellipsoids_are_of_three_sigma_and_residuals_end_on_the_way_to_the_foot(tmp_path, chunks):
    turn = gtsam.Rot3.RzRyRx(0.3, -0.4, 1.0).matrix()
    covariance = turn @ np.diag([4e-4, 1e-4, 9e-4]) @ turn.T
    unknown = np.full((3, 3), np.nan)
    with RerunViewer(tmp_path / "run.rrd", exaggerate=5.0) as viewer:
        viewer.show(frame(0, position_covariance=covariance), around)
        viewer.show(frame(1, position_covariance=unknown), around)
    _, found, _ = chunks(tmp_path / "run.rrd")
    half, nothing = column(found, "/map/covariance", "Ellipsoids3D:half_sizes")
    assert nothing == []
    (quaternion,) = column(found, "/map/covariance", "Ellipsoids3D:quaternions")[0]
    x, y, z, w = quaternion
    axes = gtsam.Rot3.Quaternion(w, x, y, z).matrix()
    drawn = axes @ np.diag((np.array(half[0]) / 15.0) ** 2) @ axes.T
    np.testing.assert_allclose(drawn, covariance, atol=1e-9)
    strips = np.array(column(found, "/map/matches/residuals", "LineStrips3D:strips")[0])
    seen = frame(0)
    np.testing.assert_allclose(strips[:, 0], seen.points, atol=1e-6)
    np.testing.assert_allclose(strips[:, 1], seen.points + 0.05, atol=1e-6)


def test_much_is_thinned_and_loops_are_told_apart(tmp_path, chunks):
    with RerunViewer(tmp_path / "run.rrd", most_sweep=20, most_map=90) as viewer:
        viewer.show(frame(0), around)
    _, found, _ = chunks(tmp_path / "run.rrd")
    assert {
        name: len(column(found, f"/map/{name}", "Points3D:positions")[0])
        for name in ("sweep", "surroundings/edges", "surroundings/planes")
    } == {"sweep": 20, "surroundings/edges": 30, "surroundings/planes": 60}
    assert [
        len(column(found, f"/map/loops/{name}", "LineStrips3D:strips")[0])
        for name in ("used", "switched_off")
    ] == [2, 1]


def test_an_error_in_the_run_closes_the_file_and_no_frame_leaves_none(tmp_path, chunks):
    def broken():
        with RerunViewer(tmp_path / "run.rrd") as viewer:
            viewer.show(frame(0), around)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken()
    assert chunks(tmp_path / "run.rrd")[0]["/map/sweep"] == 1
    with RerunViewer(tmp_path / "none.rrd") as viewer:
        pass
    assert not (tmp_path / "none.rrd").exists()
    with pytest.raises(OutputError, match="closed"):
        viewer.show(frame(0), around)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_recording_of_a_killed_process_can_be_read(tmp_path, chunks):
    code = f"""
import os, sys, time
sys.path[:0] = {sys.path!r}
from support.frames import around, frame
from loam_gtsam.view.rerun_viewer import RerunViewer
viewer = RerunViewer({str(tmp_path / "run.rrd")!r})
for number in range(5):
    viewer.show(frame(number), around)
viewer._streams[0].flush()
time.sleep(0.2)
os._exit(9)
"""
    subprocess.run([sys.executable, "-c", code], timeout=60)
    assert chunks(tmp_path / "run.rrd")[0]["/map/sweep"] == 5


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no full disk to write to")
def test_a_disk_that_is_full_ends_the_run_with_an_error(tmp_path, chunks):
    (tmp_path / "run.rrd").symlink_to("/dev/full")

    def shown():
        with RerunViewer(tmp_path / "run.rrd", overwrite=True) as viewer:
            for number in range(10_000):
                viewer.show(frame(number), around)

    with pytest.raises(OutputError, match="free some space"):
        shown()


@pytest.mark.skipif(sys.platform != "linux", reason="a screen is taken for granted")
def test_without_a_screen_a_file_is_offered_instead_of_a_window(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    done = loam("run", "sim:room?frames=2", "--view", "--output", tmp_path / "out")
    assert done.exit_code == 1
    assert "--rrd FILE.rrd" in done.output


def test_the_command_line_saves_a_recording_and_says_how_to_open_it(tmp_path, chunks):
    path = tmp_path / "run.rrd"
    world, folder = "sim:room?frames=3&columns=450", tmp_path / "out"
    arguments = ("run", world, "--no-plot", *QUICK_START, "--output", folder)
    done = loam(*arguments, "--rrd", path)
    assert done.exit_code == 0, done.output
    assert "rerun" in done.output
    assert chunks(path)[0]["/map/sweep"] == 3
    again = loam(*arguments, "--rrd", path)
    assert again.exit_code == 1
    assert "--overwrite" in again.output
