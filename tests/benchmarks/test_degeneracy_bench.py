"""The degeneracy bench: its policies on a problem in closed form, its angles, and a short run."""

import numpy as np
import pytest

from benchmarks import degeneracy
from benchmarks.degeneracy import POLICIES, Step, cosines, nees, split

FORM = np.diag([100.0, 100, 100, 1, 1, 1])
X = np.eye(6)[3]


def corridor(information_along):
    """The guess is wrong by 1 m along x, of which the expected pose knows, and by 0.1 m along y."""
    information = 1e4 * FORM
    information[3, 3] = information_along
    true = np.array([0.0, 0, 0, 1.0, 0.1, 0])
    weak = np.outer(X, X)
    return Step(information, information @ (true - X), weak, X, 400.0 * np.eye(6), FORM), true


@pytest.mark.parametrize(
    ("policy", "along"),
    [
        ("prior", 1.0), ("project", 1.0), ("off", 0.0), ("tsvd", 0.0), ("tikhonov", 0.0),
        ("constraint", 0.0), ("precondition", 0.0),
    ],
)  # fmt: skip
def test_along_the_weak_direction_a_policy_goes_where_it_says(policy, along):
    """The noise of the matches says that there is nothing to correct along x."""
    problem, true = corridor(25.0)
    step, covariance = getattr(degeneracy, policy)(problem)
    assert step[3] == pytest.approx(along, abs=1e-6)
    np.testing.assert_allclose(np.delete(step, 3), np.delete(true, 3), atol=2e-3)
    assert np.linalg.eigvalsh(covariance)[0] > -1e-12
    if policy in ("prior", "project"):
        assert covariance[3, 3] == pytest.approx(1.0 / 400.0)


def test_a_bounded_step_is_no_longer_than_its_bound():
    problem, _ = corridor(25.0)
    far = Step(problem.information, problem.right + 25.0 * X, problem.weak, *(
        problem.expected, problem.precision, FORM))  # fmt: skip
    assert degeneracy.off(far)[0][3] == pytest.approx(1.0)
    assert degeneracy.constraint(far)[0][3] == pytest.approx(degeneracy.MISTAKE)


def test_all_policies_agree_where_nothing_is_weak():
    problem, _ = corridor(1e4)
    seen = Step(problem.information, problem.right, np.zeros((6, 6)), *(
        problem.expected, problem.precision, FORM))  # fmt: skip
    steps = [policy(seen)[0] for policy in POLICIES]
    for step in steps:
        np.testing.assert_allclose(step, steps[-1], atol=1e-9)


def test_errors_are_split_and_spans_compared_by_the_displacement_of_points():
    turned = np.array([[0.0, 0, 0.1, 1, 0, 0]])  # a turn by 0.1 rad moves the points by 1 m
    assert cosines(turned, X[None], FORM)[0] == pytest.approx(0.5**0.5)
    along, rest = split(np.array([0.0, 0, 0.1, 1, 0.3, 0]), X[None], FORM)
    np.testing.assert_allclose(along, X)
    np.testing.assert_allclose(rest, [0, 0, 0.1, 0, 0.3, 0])
    assert nees(2.0 * X, 4.0 * np.eye(6), X[None]) == pytest.approx(1.0)
    assert np.isnan(nees(X, np.eye(6) - np.outer(X, X), X[None]))


def test_a_short_run_finds_the_unseen_motions_of_a_field_and_none_in_a_room(tmp_path, capsys):
    assert degeneracy.main(["--quick", "--output", str(tmp_path)]) == 0
    first = capsys.readouterr().out
    assert "| open_field | aligned | 3 | 3 | 1 | 1 |" in first
    assert "| room | aligned | 3 | 0 | 1 |" in first
    degeneracy.main(["--quick", "--output", str(tmp_path)])
    assert capsys.readouterr().out == first
    assert {path.name for path in tmp_path.iterdir()} == {"detectors.csv", "policies.csv"}
