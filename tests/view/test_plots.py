"""Pictures are written, small, the same every time, and drawn from the data."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from support.frames import frame
from support.trajectories import disturbed, winding

from loam_gtsam.types import FrameStatus, MapUpdate, OutputError, Trajectory
from loam_gtsam.view import plots as visualization
from loam_gtsam.view.frame_plot import plot_frame
from loam_gtsam.view.frame_view import RESIDUAL_COLOURS, FrameView, MapView

gtsam = pytest.importorskip("gtsam")
image = pytest.importorskip("matplotlib.image")
colors = pytest.importorskip("matplotlib.colors")


def circle(count: int = 100) -> Trajectory:
    angle = np.linspace(0.0, 6.0, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = 20.0 * np.sin(angle), 20.0 * np.cos(angle)
    return Trajectory(np.arange(count) * 100_000_000, poses)


def updates(count: int) -> list[MapUpdate]:
    pose = gtsam.Pose3()
    timings = {"read": 0.01, "solve": 0.02}
    return [MapUpdate(n, pose, FrameStatus.OK, timings=timings if n else {}) for n in range(count)]


def has_colour(path, colour: str, pixels_at_least: int = 50) -> bool:
    """Whether a fair number of pixels is (almost) of a colour; text alone has a few greys."""
    rgb = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    pixels = image.imread(path)[..., :3]
    return bool((np.abs(pixels - rgb).max(axis=2) < 0.02).sum() >= pixels_at_least)


def test_rounding_does_not_stretch_a_logarithmic_axis(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(visualization, "save_figure", lambda figure, path: figures.append(figure))
    curve = np.arange(3.0), np.array([1e-38, 0.1, 0.2])
    nothing = np.zeros(0), np.zeros(0)
    visualization.plot_curves("x.png", {"y": {"first": nothing, "b": curve}}, "x", log=True)
    (axes,) = figures[0].axes
    assert axes.get_ylim()[0] > 0.01
    assert [text.get_text() for text in figures[0].legends[0].get_texts()] == ["b"]


def test_trajectory_with_and_without_truth(tmp_path):
    visualization.plot_trajectory(tmp_path / "a.png", circle())
    visualization.plot_trajectory(tmp_path / "b.png", circle(), circle(50))
    assert has_colour(tmp_path / "a.png", visualization.PATH)
    assert not has_colour(tmp_path / "a.png", visualization.TRUTH, 400)
    assert has_colour(tmp_path / "b.png", visualization.TRUTH, 400)


def test_map_shows_points_by_height_and_the_path(tmp_path):
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-30, 30, (20000, 2)), np.zeros(20000)])
    wall = np.column_stack([np.full(5000, 15.0), rng.uniform(-30, 30, 5000), np.full(5000, 8.0)])
    visualization.plot_map(tmp_path / "flat.png", ground[:10], ground)
    visualization.plot_map(tmp_path / "map.png", wall, ground, circle())
    dark = visualization._HEIGHT_COLOURS[-1]
    assert has_colour(tmp_path / "map.png", visualization.PATH)
    assert has_colour(tmp_path / "map.png", dark)
    assert not has_colour(tmp_path / "flat.png", visualization.PATH)


def test_the_busiest_map_stays_small(tmp_path):
    noise = np.random.default_rng(0).uniform(-400.0, 400.0, (600_000, 3))
    visualization.plot_map(tmp_path / "map.png", noise[:0], noise, circle(1000))
    assert (tmp_path / "map.png").stat().st_size < 500_000


@pytest.mark.parametrize("count", [0, 1, 2])
def test_little_data_can_be_drawn(tmp_path, count):
    few = Trajectory(np.arange(count), np.tile(np.eye(4), (count, 1, 1)))
    visualization.plot_trajectory(tmp_path / "t.png", few)
    visualization.plot_map(tmp_path / "m.png", np.zeros((count, 3)), np.zeros((0, 3)), few)
    visualization.plot_timings(tmp_path / "s.png", updates(count))
    for name in ("t.png", "m.png", "s.png"):
        assert image.imread(tmp_path / name).ndim == 3


def test_points_that_are_not_finite_are_left_out(tmp_path):
    points = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [np.inf, 2.0, 1.0], [5.0, 5.0, 1.0]])
    visualization.plot_map(tmp_path / "m.png", points, points[:0])
    assert (tmp_path / "m.png").exists()


def test_errors_are_drawn_over_time(tmp_path):
    stamps = np.arange(50) * 100_000_000
    visualization.plot_errors(tmp_path / "a.png", stamps, np.linspace(0.0, 0.1, 50))
    visualization.plot_errors(tmp_path / "none.png", stamps[:0], np.zeros(0))
    assert has_colour(tmp_path / "a.png", visualization.PATH)
    assert not has_colour(tmp_path / "none.png", visualization.PATH)
    told = stamps, np.full((50, 6), 0.001), np.full((50, 6), 0.002)
    visualization.plot_errors(tmp_path / "told.png", stamps, np.full(50, 0.003), told)
    sizes = [image.imread(tmp_path / name).shape[0] for name in ("a.png", "told.png")]
    assert sizes[1] > 1.5 * sizes[0]


def test_loops_are_drawn_in_the_last_panel_only(tmp_path):
    way = circle().positions
    panels = {"before": (way, way), "after": (way, way)}
    loops = np.array([[[-15.0, -15.0, 0.0], [15.0, 15.0, 0.0]]])
    for name, drawn in (("with.png", loops), ("without.png", loops[:0])):
        visualization.plot_loops(tmp_path / name, panels, drawn)
    one, other = (image.imread(tmp_path / f"{name}.png") for name in ("with", "without"))
    columns = np.flatnonzero(np.abs(one - other).max(axis=(0, 2)) > 0.1)
    assert one.shape == other.shape
    assert columns.min() > 0.5 * one.shape[1]


def seen(residuals: np.ndarray, **changes) -> FrameView:
    rng = np.random.default_rng(0)
    points = rng.uniform(-12.0, 12.0, (len(residuals), 3))
    covariance, sweep = np.diag([0.0025, 0.0025, 0.0025]), rng.uniform(-12.0, 12.0, (3000, 3))
    values = {"position_covariance": covariance, "sweep": sweep, "residuals": residuals}
    features = dict.fromkeys(("edges", "planes", "points", "feet"), points)
    return frame(0, **(values | features | changes))


NOTHING = np.zeros((0, 3))
NO_MAP = MapView(NOTHING, NOTHING, NOTHING, np.zeros((0, 2, 3)), np.zeros(0, np.bool_))


def test_a_frame_shows_its_matches_by_their_residuals(tmp_path):
    colours = RESIDUAL_COLOURS[0], RESIDUAL_COLOURS[-1]
    shown = {}
    for name, residuals in (("good", np.zeros(300)), ("bad", np.full(300, 9.0))):
        plot_frame(tmp_path / f"{name}.png", seen(residuals), NO_MAP)
        shown[name] = [has_colour(tmp_path / f"{name}.png", colour, 600) for colour in colours]
    assert shown == {"good": [True, False], "bad": [False, True]}
    # See-through, over white.
    ellipse = colors.to_hex(0.2 * np.array(colors.to_rgb(visualization.INK)) + 0.8)
    assert has_colour(tmp_path / "bad.png", ellipse, 2000)
    bare = seen(np.zeros(0), sweep=np.zeros((0, 3)), position_covariance=np.full((3, 3), np.nan))
    plot_frame(tmp_path / "bare.png", bare, NO_MAP)
    assert not has_colour(tmp_path / "bare.png", ellipse, 2000)


def test_a_direction_that_is_not_seen_hides_nothing(tmp_path):
    shown = seen(np.zeros(300), position_covariance=np.diag([25.0, 0.0025, 0.0025]))
    plot_frame(tmp_path / "f.png", shown, NO_MAP)
    assert has_colour(tmp_path / "f.png", RESIDUAL_COLOURS[0], 600)
    assert not has_colour(tmp_path / "f.png", visualization.INK, 30_000)


def test_a_map_of_a_room_has_no_ceiling_and_one_of_a_street_has_its_walls():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-4, 4, (4000, 2)), np.full(4000, -1.0)])
    roof, way = np.add(floor, [0.0, 0.0, 3.0]), circle().positions * 0.1
    far = roof[np.linalg.norm(roof[:, :2], axis=1) > 3.6]  # as with beams that rise little
    for high in (roof, far):
        points = np.concatenate([floor, high])
        assert visualization._below_ceiling(points, way).shape == floor.shape
        assert visualization._below_ceiling(points, way[:0]).shape == points.shape
    wall = np.column_stack([np.full(900, 4.0), rng.uniform(-4, 4, 900), rng.uniform(-1, 3, 900)])
    street = np.concatenate([floor, wall])
    assert visualization._below_ceiling(street, way).shape == street.shape


def test_timings_show_a_colour_per_stage(tmp_path):
    visualization.plot_timings(tmp_path / "s.png", updates(50))
    for colour in visualization._STAGE_COLOURS[:2]:
        assert has_colour(tmp_path / "s.png", colour)
    assert not has_colour(tmp_path / "s.png", visualization._STAGE_COLOURS[3])


def test_the_same_data_gives_the_same_bytes(tmp_path):
    for name in ("a.png", "b.png"):
        visualization.plot_trajectory(tmp_path / name, circle())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_without_matplotlib_the_error_says_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(OutputError, match=r'pip install "loam_gtsam\[plot\]"'):
        visualization.plot_trajectory(tmp_path / "t.png", circle())
    with pytest.raises(OutputError, match=r'pip install "loam_gtsam\[plot\]"'):
        plot_frame(tmp_path / "f.png", seen(np.zeros(0)), NO_MAP)
    assert list(tmp_path.iterdir()) == []


def test_pictures_show_every_solver(tmp_path):
    first, second = visualization._RUN_COLOURS[:2]
    paths = {"a": winding(), "b": disturbed(winding(), size=0.3)}
    visualization.plot_trajectories(tmp_path / "two.png", paths, winding())
    visualization.plot_trajectories(tmp_path / "one.png", {"a": winding()})
    for colour in (first, second, visualization.TRUTH):
        assert has_colour(tmp_path / "two.png", colour)
    assert has_colour(tmp_path / "one.png", first)
    assert not has_colour(tmp_path / "one.png", second)
    x = np.arange(50)
    curves = {"a": (x, 1.0 + x), "b": (x, 60.0 - x)}
    visualization.plot_curves(tmp_path / "c.png", {"y": curves, "z": curves}, "x", log=True)
    assert has_colour(tmp_path / "c.png", first)
    assert has_colour(tmp_path / "c.png", second)
    visualization.plot_stages(tmp_path / "s.png", {"a": {"match": 3.0}, "b": {"other": 2.0}})
    assert has_colour(tmp_path / "s.png", visualization._STAGE_COLOURS[0])
    assert has_colour(tmp_path / "s.png", visualization._STAGE_COLOURS[1])
