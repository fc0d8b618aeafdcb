"""A run in the Rerun viewer: live in a window, or saved as an ``.rrd`` file. ``viewer`` extra.

docs/seeing.md lists the entities. Time lines are ``frame``, the number, and ``stamp``.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.io.atomic import ClosingWriter
from loam_gtsam.types import FloatArray, FrameStatus, OutputError
from loam_gtsam.view.frame_view import FrameView, MapView, residual_colours
from loam_gtsam.view.rrd_file import RrdFile

_NAME = "loam_gtsam"
_MEMORY = "2GB"  # what the viewer may take; it then forgets the oldest frames
_FLUSH_SECONDS = 10.0
_SIGMAS = 3.0
_SWEEP, _MAP_EDGE, _MAP_PLANE = (220, 226, 232), (150, 160, 172), (96, 106, 118)
_EDGE, _PLANE, _PATH = (228, 87, 46), (63, 143, 166), (228, 87, 46)
_LOOP_ON, _LOOP_OFF, _ELLIPSOID = (46, 158, 107), (194, 34, 47), (238, 202, 59)
_CURVES = {
    "matches/edges": _EDGE,
    "matches/planes": _PLANE,
    "residual/median": _SWEEP,
    "sigma_mm/x": (214, 64, 69),
    "sigma_mm/y": (46, 158, 107),
    "sigma_mm/z": (63, 108, 201),
    "milliseconds/frame": _SWEEP,
}
"""Entities below ``frame`` and their colours: those of the features, of the axes, or none."""
_LIDAR = "map/lidar"
_AXES = 0.5  # metres, of the origin of the lidar
_EYE = (-13.0, -8.0, 10.0)  # metres from the lidar at the start, behind, to the right and above
_MOST_PATH = 2_000  # points of the trajectory that are drawn at most
_FINE = (FrameStatus.OK, FrameStatus.FIRST)


class RerunViewer(ClosingWriter):
    """Shows the frames of a run; :func:`loam_gtsam.view.observers.watch` makes them.

    Leaving the block closes the file, after an error or Ctrl-C too; what a killed process wrote can
    be opened as well. A window that is closed does not disturb the run. Raises OutputError if Rerun
    is missing, the file exists or cannot be written, or there is no screen.

    Parameters
    ----------
    path : of a new ``.rrd`` file; None saves none
    window : also open a window; without ``path`` there is always one
    overwrite : replace an earlier file
    every : frames between two views of the map, the trajectory and the loops
    exaggerate : how many times as large as they are residuals and the ellipsoid are drawn
    most_sweep, most_map : points of a sweep, and of the map around it, that are drawn at most; of
        more, so many evenly spread ones

    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        window: bool = False,
        overwrite: bool = False,
        every: int = 10,
        exaggerate: float = 10.0,
        most_sweep: int = 20_000,
        most_map: int = 60_000,
    ) -> None:
        self._rr = _rerun()
        self.path = None if path is None else Path(path)
        self.frames = 0  # shown so far
        self._every, self._exaggerate = max(every, 1), exaggerate
        self._most_sweep, self._most_map = most_sweep, most_map
        self._around: Callable[[], MapView] | None = None
        window = window or self.path is None
        if window:
            _check_screen()
        self._file = None if self.path is None else RrdFile(self.path, overwrite)
        # One each: a window that is closed must not cost the file anything.
        self._streams: list[Any] = [self._shown()] if window else []
        if self._file is not None:
            stream = self._rr.RecordingStream(_NAME)
            stream.save(self._file.sink, default_blueprint=_blueprint())
            self._file.opened()
            self._streams.append(stream)
        self._log("map", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._log(_LIDAR, self._rr.TransformAxes3D(_AXES), static=True)
        for curve, colour in _CURVES.items():
            name = curve.rpartition("/")[2]
            line = self._rr.SeriesLines(colors=[colour], names=[name], widths=[2.0])
            self._log(f"frame/{curve}", line, static=True)

    def show(self, frame: FrameView, around: Callable[[], MapView]) -> None:
        """Draw a frame; every tenth with the map, which ``around`` makes.

        Raises OutputError if the viewer is closed, or the file cannot be written.
        """
        if not self._streams:
            raise OutputError("the viewer is closed; nothing can be shown in it")
        if self._file is not None:
            self._file.check()
        for stream in self._streams:
            stream.set_time("frame", sequence=frame.number)
            stream.set_time("stamp", timestamp=np.datetime64(frame.update.stamp, "ns"))
        self._draw_frame(frame)
        self._plot(frame)
        self._around = around
        if self.frames % self._every == 0:
            self._draw_map()
        self.frames += 1

    def close(self) -> None:
        """Show the map as it is in the end, and close the file; OutputError if that fails."""
        if not self._streams:
            return
        self._draw_map()
        streams, self._streams = self._streams, []
        for stream in streams:
            with suppress(RuntimeError):  # the window was closed before
                stream.flush(timeout_sec=_FLUSH_SECONDS)
            stream.disconnect()
        if self._file is None or self.path is None:
            return
        self._file.finish()
        if not self.frames:
            self.path.unlink(missing_ok=True)

    def _draw_frame(self, frame: FrameView) -> None:
        rr, pose = self._rr, frame.map_T_lidar
        self._log(_LIDAR, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        self._log("map/covariance", self._ellipsoid(pose[:3, 3], frame.position_covariance))
        self._draw("map/sweep", rr.Points3D, _thinned(frame.sweep, self._most_sweep), _SWEEP, 0.75)
        self._draw("map/features/edges", rr.Points3D, frame.edges, _EDGE, 1.0)
        self._draw("map/features/planes", rr.Points3D, frame.planes, _PLANE, 1.0)
        colours = residual_colours(frame.residuals)
        ends = frame.points + self._exaggerate * (frame.feet - frame.points)
        lines = np.stack([frame.points, ends], axis=1)
        self._draw("map/matches/points", rr.Points3D, frame.points, colours, 1.5)
        self._draw("map/matches/residuals", rr.LineStrips3D, lines, colours, 1.0)

    def _draw_map(self) -> None:
        if self._around is None:
            return
        rr, view, self._around = self._rr, self._around(), None
        total = max(len(view.edges) + len(view.planes), 1)
        parts = {"edges": (view.edges, _MAP_EDGE), "planes": (view.planes, _MAP_PLANE)}
        for name, (points, colour) in parts.items():
            some = _thinned(points, self._most_map * len(points) // total)
            self._draw(f"map/surroundings/{name}", rr.Points3D, some, colour, 0.5)
        self._draw("map/trajectory", rr.LineStrips3D, [_thinned(view.path, _MOST_PATH)], _PATH, 2.0)
        used, unused = view.loops[view.loops_on], view.loops[~view.loops_on]
        self._draw("map/loops/used", rr.LineStrips3D, used, _LOOP_ON, 1.5)
        self._draw("map/loops/switched_off", rr.LineStrips3D, unused, _LOOP_OFF, 1.5)

    def _plot(self, frame: FrameView) -> None:
        rr, update = self._rr, frame.update
        numbers = {
            "matches/edges": update.n_edge_matches,
            "matches/planes": update.n_plane_matches,
            "residual/median": np.median(frame.residuals) if len(frame.residuals) else np.nan,
            "milliseconds/frame": 1e3 * sum(update.timings.values()),
        }
        sigmas = 1e3 * np.sqrt(np.diag(frame.position_covariance))
        numbers |= {f"sigma_mm/{axis}": float(s) for axis, s in zip("xyz", sigmas, strict=True)}
        for name, value in numbers.items():
            self._log(f"frame/{name}", rr.Scalars(float(value)))
        if update.message:
            level = "INFO" if update.status in _FINE else "WARN"
            text = f"{update.status}: {update.message}"
            self._log("frame/messages", rr.TextLog(text, level=level))

    def _ellipsoid(self, centre: FloatArray, covariance: FloatArray) -> Any:
        """Of 3 sigma, enlarged; nothing where the covariance is not known."""
        if not np.isfinite(covariance).all():
            return self._rr.Ellipsoids3D(half_sizes=np.zeros((0, 3)))
        variances, axes = np.linalg.eigh(covariance)
        axes[:, 0] *= np.sign(np.linalg.det(axes))  # a rotation, no mirror image
        half = _SIGMAS * self._exaggerate * np.sqrt(np.maximum(variances, 0.0))
        turn = Rotation.from_matrix(axes).as_quat()
        return self._rr.Ellipsoids3D(
            centers=[centre], half_sizes=[half], quaternions=[turn], colors=[_ELLIPSOID]
        )

    def _draw(self, entity: str, kind: Any, shapes: Any, colours: Any, radius: float) -> None:
        """Points or lines of one colour or of one each, of a size on the screen."""
        colours = [colours] if isinstance(colours, tuple) else colours
        self._log(entity, kind(shapes, colors=colours, radii=self._rr.Radius.ui_points(radius)))

    def _log(self, entity: str, what: Any, *, static: bool = False) -> None:
        for stream in self._streams:
            stream.log(entity, what, static=static)

    def _shown(self) -> Any:
        # The program beside this Python, whose folder need not be on the path.
        here = shutil.which("rerun", path=str(Path(sys.executable).parent))
        stream = self._rr.RecordingStream(_NAME)
        try:
            self._rr.spawn(
                memory_limit=_MEMORY,
                hide_welcome_screen=True,
                executable_path=here,
                default_blueprint=_blueprint(),
                recording=stream,
            )
        except RuntimeError as error:
            raise OutputError(f"the viewer did not start: {error}") from error
        return stream


def _thinned(points: FloatArray, most: int) -> FloatArray:
    """So many of the points, evenly spread over the rows, the first and the last among them."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(np.int64)]


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise OutputError(
            'the viewer needs rerun-sdk; install it with: pip install "loam_gtsam[viewer]"'
        ) from error
    return rerun


def _check_screen() -> None:
    # Rerun would say so only after a while, and the run go on unseen.
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if sys.platform == "linux" and not any(os.environ.get(name) for name in screens):
        raise OutputError(
            "there is no screen to open the viewer on; save a file instead (--rrd FILE.rrd), and "
            "open it where there is one with: rerun FILE.rrd"
        )


def _blueprint() -> Any:
    from rerun import blueprint as bp

    titles = {
        "matches": "Matches",
        "residual": "Median residual [sigma]",
        "sigma_mm": "Sigma of the position [mm]",
        "milliseconds": "Time of the frame [ms]",
    }
    plots = [
        bp.TimeSeriesView(
            origin=f"frame/{name}",
            name=title,
            plot_legend=bp.PlotLegend(
                corner=bp.Corner2D.LeftTop,
                visible=sum(curve.startswith(name) for curve in _CURVES) > 1,
            ),
        )
        for name, title in titles.items()
    ]
    eye = bp.EyeControls3D(
        position=_EYE, look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0), tracking_entity=_LIDAR
    )
    scene = bp.Spatial3DView(origin="map", name="Map", eye_controls=eye)
    panel = bp.Vertical(*plots, bp.TextLogView(origin="frame/messages", name="Messages"))
    return bp.Blueprint(
        bp.Horizontal(scene, panel, column_shares=[3, 1]),
        bp.TimePanel(timeline="frame", state="collapsed"),
        collapse_panels=True,
    )
