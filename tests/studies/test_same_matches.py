"""Solvers on the same matches, frame by frame."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from support.contenders import Sweeps
from support.quick import QUICK

from loam_gtsam.pipeline import run
from loam_gtsam.studies.contenders import METHODS, Contender, Group, make_contender
from loam_gtsam.studies.same_matches import (
    TRUTH,
    SameMatches,
    Solve,
    compare_on_same_matches,
    table_of,
    write_same_matches,
)
from loam_gtsam.types import FrameStatus, InputError


def solvers(*names):
    return [make_contender(Group.SOLVER, name, QUICK) for name in names]


def test_the_driver_s_run_is_the_one_it_would_have_alone(dataset):
    updates = []
    result = compare_on_same_matches(
        dataset,
        solvers("aloam", "gtsam"),
        driver="gtsam",
        disturbances=(),
        on_frame=lambda number, update: updates.append(update),
    )
    alone = run(dataset, QUICK)
    for ours, theirs in zip(updates, alone.updates, strict=True):
        # But for the last bit: the other solver has looked for neighbours in the same map.
        poses = ours.map_T_lidar.matrix(), theirs.map_T_lidar.matrix()
        np.testing.assert_allclose(*poses, rtol=0.0, atol=1e-12)
    assert list(result.frames) == [n for n, u in enumerate(updates) if u.status is FrameStatus.OK]
    assert {len(solves) for solves in result.solves.values()} == {len(result.frames)}


def test_a_solver_beside_itself_differs_in_nothing(dataset):
    twins = [*solvers("gtsam"), Contender("twin", QUICK, Group.SOLVER)]
    result = compare_on_same_matches(dataset, twins, disturbances=((0.01, 0.1),))
    for solve in result.solves["twin"]:
        assert (solve.metres, solve.degrees, solve.cost) == pytest.approx(
            (0.0, 0.0, 1.0), abs=1e-12
        )
        assert solve.returned == (True,)
        assert solve.solve_ms > 0.0
        assert solve.match_ms > 0.0


def test_the_truth_can_make_the_map_and_is_what_errors_are_taken_from(dataset, tmp_path):
    result = compare_on_same_matches(dataset, solvers(*METHODS), driver=TRUTH)
    for name, solves in result.solves.items():
        errors = [solve.error_m for solve in solves if np.isfinite(solve.error_m)]
        assert errors, name
        assert np.median(errors) < 0.05, name
    table = table_of(result)
    assert [row[0] for row in table.rows] == list(METHODS)
    assert {len(row) for row in table.rows} == {len(table.header)}
    assert write_same_matches(result, tmp_path) == ["same_matches.csv", "report.html"]
    with open(tmp_path / "same_matches.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(METHODS) * len(result.frames)
    assert "the map is made by truth" in (tmp_path / "report.html").read_text()


def test_the_table_has_the_names_as_they_are_and_nothing_for_what_is_not_known(tmp_path):
    name = "mine:make_nano_solver, quick"
    solve = Solve(True, True, 3, 4, 50, 0.0, 0.0, np.nan, np.nan, 1.0, 2.0, 3.0, (True, False))
    write_same_matches(
        SameMatches("room", name, {name: [solve]}, [7], ((1.0, 5.0), (2.0, 9.0))), tmp_path
    )
    with open(tmp_path / "same_matches.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["solver"], row["frame"], row["matches"], row["error_m"]) == (name, "7", "50", "")
    assert (row["converged"], row["back_1m_5deg"], row["back_2m_9deg"]) == ("1", "1", "0")


def test_what_cannot_be_asked_is_refused(dataset, sweeps):
    for contenders, driver in (
        ([], ""),
        ([make_contender(Group.PEER, "kiss-icp", QUICK)], ""),
        (solvers("gtsam", "gtsam"), ""),
        (solvers("gtsam"), "loam"),
    ):
        with pytest.raises(InputError, match="same matches: expected solvers"):
            compare_on_same_matches(dataset, contenders, driver=driver)
    with pytest.raises(InputError, match="no truth to place the sweeps by"):
        compare_on_same_matches(Sweeps(sweeps), solvers("gtsam"), driver=TRUTH)
