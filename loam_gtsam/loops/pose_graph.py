"""Keyframes of a run as a graph of poses, updated by iSAM2 as the run goes.

Poses of a run drift. Keyframes, the motion between them with its covariance, and loops that were
found between them tell where they really are. A loop that contradicts the others is switched off.
Equations: docs/maths/pose_graph.md.

Keys of the graph are the numbers of the keyframes. The frame of the mapper's poses is ``odom``
here: continuous, and drifting; ``map`` is the corrected one (ROS REP-105).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.geometry import as_vector, transform
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.loops.batch import (
    OptimizedGraph,
    SavedGraph,
    chi_squared,
    optimize_graph,
    relative_pose_covariance,
)
from loam_gtsam.loops.consistency import LoopConsistency
from loam_gtsam.loops.keyframes import (
    Keyframe,
    LoopClosure,
    direction,
    noise_model,
    odometry_between,
)
from loam_gtsam.types import (
    Features,
    FloatArray,
    InputError,
    MapUpdate,
    Trajectory,
    stack_poses,
)

_RELINEARIZE = 1e-3
"""rad or m by which a pose moves before iSAM2 linearises anew: what is missed is its square."""
_ROUNDS = 20
"""Updates of iSAM2 at most until the poses stay; one is enough without loops."""
_ANYWHERE = np.repeat([np.pi, 100.0], 3)
"""rad and m: standard deviations of where another run began."""
_STILL = 1e-5
"""rad and m; poses that move less in an update stay."""
_LIKELY = 12.6
"""Squared Mahalanobis distance that 95 % of right loops do not exceed."""
_SWITCHES = 50
"""Loops switched on or off at most after a new one."""


class PoseGraph:
    """Keyframes, what is known between them, and where they are.

    Parameters
    ----------
    config : ``pose_graph``; ``deskew`` and the voxels of ``map`` for the keyframes' features
    imu : for the rotation within the sweeps; None for constant velocity

    Attributes
    ----------
    imu : as given
    keyframes : in the order of time
    loops : all that were added
    """

    def __init__(self, config: Config | None = None, *, imu: ImuBuffer | None = None) -> None:
        self._whole = config or Config()
        self.config = self._whole.pose_graph
        self.imu = imu
        self.keyframes: list[Keyframe] = []
        self.loops: list[LoopClosure] = []
        self._session = 0
        self._journal: list[tuple[Any, ...]] = []  # what went into iSAM2, to go the same way again
        self._slots: list[int | None] = []  # of the loops in iSAM2; None: switched off
        self._consistency = LoopConsistency(self.config, self.loops, self.keyframes)
        self._fixed = gtsam.NonlinearFactorGraph()  # all factors but loops
        self._poses = gtsam.Values()
        self._isam = _new_isam()

    def __getstate__(self) -> tuple[int, list[tuple[Any, ...]]]:
        return self._session, self._journal

    def __setstate__(self, state: tuple[int, list[tuple[Any, ...]]]) -> None:
        session, journal = state
        again: dict[str, Callable[..., object]] = {
            "keyframe": self._append,
            "position": self.add_position,
            "gravity": self.add_gravity,
            "loop": self._note,
            "switch": self._switch,
            "optimize": self.optimize,
        }
        for step, *given in journal:
            again[step](*given)
        self._session = session

    def __len__(self) -> int:
        return len(self.keyframes)

    # -- what goes in --------------------------------------------------------------------------

    def add(self, update: MapUpdate, features: Features | None = None) -> Keyframe | None:
        """Take a frame of the run, if it was solved and is far enough from the last keyframe.

        Parameters
        ----------
        update : of the frame, in the order of time
        features : of its sweep; without them no loop can be found by the keyframe

        Returns
        -------
        The new keyframe; None if the frame is none.

        Raises
        ------
        InputError
            If the frame is not later than the last keyframe.
        """
        if update.uncertainty is None or not update.status.solved:
            return None
        last = self.keyframes[-1] if self.keyframes else None
        starts = last is None or last.session != self._session
        motion = gtsam.Pose3()
        if last is not None and not starts:
            if update.stamp <= last.stamp:
                raise InputError(
                    f"PoseGraph.add: expected a stamp after {last.stamp}, that of the last "
                    f"keyframe, got {update.stamp}; add the frames of a run in their order"
                )
            motion = last.odom_T_lidar.between(update.map_T_lidar)
            turned = np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(motion.rotation())))
            moved = float(np.linalg.norm(motion.translation()))
            config = self.config
            if moved < config.keyframe_distance and turned < config.keyframe_angle_deg:
                return None
        keyframe = self._keyframe(update, motion, features)
        self._append(keyframe)
        return keyframe

    def new_session(self) -> None:
        """The frames to come are of another run: nothing but loops ties it to those before.

        Its first keyframe is put where its own run has it, within a hundred metres and any heading.
        """
        if self.keyframes and self.keyframes[-1].session == self._session:
            self._session += 1

    def add_position(self, index: int, position: FloatArray, covariance: FloatArray) -> None:
        """Take a measured position of a keyframe, as from GPS.

        Parameters
        ----------
        index : of the keyframe
        position : (3,) metres, in the frame of the map
        covariance : (3, 3) m^2

        Raises
        ------
        InputError
            If there is no such keyframe, or the covariance is not positive definite.
        """
        self._known(index)
        where = as_vector(position, "position")
        self._add_factor(gtsam.GPSFactor(index, where, noise_model(covariance, 3)))
        self._journal.append(("position", index, position, covariance))

    def add_gravity(
        self, index: int, up_lidar: FloatArray, sigma: float, up_map: Sequence[float] = (0, 0, 1)
    ) -> None:
        """Take the direction of gravity at a keyframe: its roll and pitch, not its yaw.

        Parameters
        ----------
        index : of the keyframe
        up_lidar : (3,) the upward direction in the lidar's axes; any length
        sigma : standard deviation, rad
        up_map : (3,) the same in the map's axes

        Raises
        ------
        InputError
            If there is no such keyframe, or a direction has no length.
        """
        self._known(index)
        here, there = direction("up_lidar", up_lidar), direction("up_map", up_map)
        if not sigma > 0.0:
            raise InputError(f"sigma: expected rad above 0, got {sigma!r}")
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        self._add_factor(gtsam.AttitudeFactorPose3(index, there, noise, here))
        self._journal.append(("gravity", index, up_lidar, sigma, up_map))

    def add_loop(self, loop: LoopClosure) -> bool:
        """Take a loop; those that contradict the rest of the graph are switched off.

        Of loops that contradict each other the larger number is believed that agree pairwise
        (Mangelson et al., Pairwise Consistent Measurement Set Maximization, ICRA 2018). Then a loop
        is on if its squared Mahalanobis distance from what all the others say is not above
        ``pose_graph.max_chi2``; all are tested anew, since right ones make others easier to tell.

        Returns
        -------
        Whether the loop is on.

        Raises
        ------
        InputError
            If a keyframe is unknown, the two are neighbours or swapped, or the covariance is not
            positive definite.
        """
        for index in (loop.earlier, loop.later):
            self._known(index)
        if loop.later - loop.earlier < 2:
            raise InputError(
                f"loop: expected keyframes in their order that are no neighbours, got "
                f"{loop.earlier} and {loop.later}; if they are swapped, invert the motion"
            )
        noise_model(loop.covariance)
        number = self._note(loop)
        on = {other for other, slot in enumerate(self._slots) if slot is not None}
        distance = self.chi_squared(number)
        if distance <= min(_LIKELY, self.config.max_chi2):
            # It changes little, so of the others only those that are off are tested anew.
            self._switch(number, True)
            self._settle(sorted(set(range(number)) - on))
            return self._slots[number] is not None
        agrees = on <= self._consistency.agreeing(number)
        if agrees and distance <= self.config.max_chi2:
            self._switch(number, True)
        else:
            most = self._consistency.clique(number)
            # The others were the wrong ones, or the odometry is worse than it knows.
            if len(most) > max(len(on), self.config.believed_loops - 1 if agrees else 0):
                for other in sorted(on - most):
                    self._switch(other, False)
                for other in sorted(most - on):
                    self._switch(other, True)
        if any((slot is not None) != (other in on) for other, slot in enumerate(self._slots)):
            self._settle(range(len(self.loops)))
        return self._slots[number] is not None

    # -- what comes out ------------------------------------------------------------------------

    def pose(self, index: int) -> gtsam.Pose3:
        """``map_T_lidar`` of a keyframe."""
        return self._poses.atPose3(self._known(index))

    def poses(self) -> FloatArray:
        """(N, 4, 4) ``map_T_lidar`` of all keyframes."""
        return stack_poses(self._poses.atPose3(index) for index in range(len(self)))

    def covariance(self, index: int) -> FloatArray:
        """(6, 6) marginal covariance of a keyframe's pose in the map."""
        found: FloatArray = self._isam.marginalCovariance(self._known(index))
        return found

    def relative(self, earlier: int, later: int) -> tuple[gtsam.Pose3, FloatArray]:
        """``earlier_T_later`` of two keyframes and its (6, 6) covariance."""
        first, second = self.pose(earlier), self.pose(later)
        if earlier == later:
            return gtsam.Pose3(), np.zeros((6, 6))
        joint = self._isam.jointMarginalCovariance([earlier, later])
        between = first.between(second)
        return between, relative_pose_covariance(between, joint, earlier, later)

    @property
    def correction(self) -> gtsam.Pose3:
        """``map_T_odom``: what leads from the mapper's drifting frame to the map now."""
        if not self.keyframes:
            return gtsam.Pose3()
        last = self.keyframes[-1]
        return self.pose(last.index).compose(last.odom_T_lidar.inverse())

    @property
    def active(self) -> tuple[bool, ...]:
        """Which of ``loops`` are on."""
        return tuple(slot is not None for slot in self._slots)

    def chi_squared(self, number: int) -> float:
        """Squared Mahalanobis distance of a loop from what all other factors say, of 6 freedoms."""
        loop = self.loops[number]
        between, covariance = self.relative(loop.earlier, loop.later)
        on = self._slots[number] is not None
        return chi_squared(loop.earlier_T_later, loop.covariance, between, covariance, included=on)

    def trajectory(self, updates: Sequence[MapUpdate], session: int = 0) -> Trajectory:
        """The frames of a run, corrected: between two keyframes, by both in proportion of time.

        Parameters
        ----------
        updates : frames of the run that the keyframes are of; those with a bad stamp are left out
        session : which run that was, see :meth:`new_session`
        """
        keyframes = [keyframe for keyframe in self.keyframes if keyframe.session == session]
        good = [update for update in updates if update.status.has_pose]
        stamps = np.array([update.stamp for update in good], np.int64)
        starts = np.array([keyframe.stamp for keyframe in keyframes], np.int64)
        nexts = np.searchsorted(starts, stamps, side="right").tolist()
        poses = [
            self._corrected(update, after, keyframes)
            for update, after in zip(good, nexts, strict=True)
        ]
        return Trajectory.from_poses(stamps, poses)

    def map_points(self) -> tuple[FloatArray, FloatArray]:
        """Edge and plane features of all keyframes in the map, (E, 3) and (P, 3) metres."""
        edges, planes = [np.empty((0, 3))], [np.empty((0, 3))]
        for keyframe, pose in zip(self.keyframes, self.poses(), strict=True):
            edges.append(transform(pose, keyframe.edges))
            planes.append(transform(pose, keyframe.planes))
        return np.concatenate(edges), np.concatenate(planes)

    def saved(self) -> SavedGraph:
        """The graph as it is written to files: all loops, those switched off too, no kernels."""
        graph = gtsam.NonlinearFactorGraph(self._fixed)
        for loop in self.loops:
            graph.add(loop.factor())
        stamps = {keyframe.index: keyframe.stamp for keyframe in self.keyframes}
        return SavedGraph(graph, gtsam.Values(self._poses), stamps)

    def optimize(self) -> OptimizedGraph:
        """Solve the whole graph at once, loops tested from scratch, and go on from there."""
        self._journal.append(("optimize",))
        result = optimize_graph(self.saved(), max_chi2=self.config.max_chi2)
        on = [report.on for report in result.loops]
        self._isam = _new_isam()
        graph = gtsam.NonlinearFactorGraph(self._fixed)
        self._slots = [None] * len(on)
        for number in np.flatnonzero(on).tolist():
            self._slots[number] = graph.size()
            graph.add(self.loops[number].factor(self.config.kernel_width))
        self._isam.update(graph, result.poses)
        self._poses = self._isam.calculateBestEstimate()
        return result

    # -- inside --------------------------------------------------------------------------------

    def _keyframe(
        self, update: MapUpdate, motion: gtsam.Pose3, features: Features | None
    ) -> Keyframe:
        way = float(np.linalg.norm(motion.translation()))
        way += self.keyframes[-1].way if self.keyframes else 0.0
        edges, planes, distinct = np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.bool_)
        if features is not None:
            if features.stamp != update.stamp:
                raise InputError(
                    f"features: expected those of the stamp {update.stamp}, got {features.stamp}"
                )
            sweep = MovingSweep(features, self._whole, self.imu)
            sweep.deskew(update.twist)
            to_reference = sweep.middle_T_reference(update.twist).inverse().matrix()
            edges, planes = (transform(to_reference, part) for part in (sweep.edges, sweep.planes))
            distinct = sweep.distinct
        return Keyframe(len(self), update, way, edges, planes, distinct, self._session)

    def _append(self, keyframe: Keyframe) -> None:
        """A new pose, tied to the last one of its session."""
        last = self.keyframes[-1] if self.keyframes else None
        factor: gtsam.NonlinearFactor
        if last is None or last.session != keyframe.session:
            pose = keyframe.odom_T_lidar
            covariance = keyframe.update.covariance if last is None else np.diag(_ANYWHERE**2)
            factor = gtsam.PriorFactorPose3(keyframe.index, pose, noise_model(covariance))
        else:
            motion, covariance = odometry_between(last, keyframe, self.config)
            pose = self.pose(last.index).compose(motion)
            noise = noise_model(covariance)
            factor = gtsam.BetweenFactorPose3(last.index, keyframe.index, motion, noise)
        self.keyframes.append(keyframe)
        self._journal.append(("keyframe", keyframe))
        self._add_factor(factor, pose)

    def _note(self, loop: LoopClosure) -> int:
        """A new loop, switched off; its number."""
        self.loops.append(loop)
        self._slots.append(None)
        self._journal.append(("loop", loop))
        return len(self.loops) - 1

    def _add_factor(self, factor: gtsam.NonlinearFactor, pose: gtsam.Pose3 | None = None) -> None:
        """A factor that is no loop, and the first estimate of the newest pose if that is new."""
        values = gtsam.Values()
        if pose is not None:
            values.insert(len(self) - 1, pose)
        graph = gtsam.NonlinearFactorGraph()
        graph.add(factor)
        self._fixed.add(factor)
        self._isam.update(graph, values)
        if pose is not None:
            # A new pose at the end of the chain moves no other.
            self._poses.insert(values)
        else:
            self._converge()

    def _switch(self, number: int, on: bool) -> None:
        """Put a loop into iSAM2, or take it out."""
        self._journal.append(("switch", number, on))
        graph, removed = gtsam.NonlinearFactorGraph(), []
        slot = self._slots[number]
        if on:
            graph.add(self.loops[number].factor(self.config.kernel_width))
        else:
            assert slot is not None
            removed = [slot]
        result = self._isam.update(graph, gtsam.Values(), removed)
        self._slots[number] = result.getNewFactorsIndices()[0] if on else None
        self._converge()

    def _converge(self) -> None:
        """Update iSAM2 until the poses stay."""
        before = self._poses
        for _ in range(_ROUNDS):
            self._isam.update()
            self._poses = self._isam.calculateBestEstimate()
            if np.abs(before.localCoordinates(self._poses).vector()).max() < _STILL:
                break
            before = self._poses

    def _settle(self, numbers: Sequence[int]) -> None:
        """Of some loops switch off that which contradicts most, or on that which fits best; until
        none is left to switch.
        """
        limit = self.config.max_chi2
        for _ in range(_SWITCHES if numbers else 0):
            tested = np.array([self.chi_squared(number) for number in numbers])
            on = np.array([self._slots[number] is not None for number in numbers])
            worst = int(np.where(on, tested, -1.0).argmax())
            best = int(np.where(on, np.inf, tested).argmin())
            if on[worst] and tested[worst] > limit:
                self._switch(numbers[worst], False)
            elif not on[best] and tested[best] <= limit:
                self._switch(numbers[best], True)
            else:
                break

    def _corrected(
        self, update: MapUpdate, after: int, keyframes: Sequence[Keyframe]
    ) -> gtsam.Pose3:
        """A frame's pose in the map; ``after`` is the place of the first later keyframe."""
        around = keyframes[max(after - 1, 0) : after + 1]
        poses = [
            self.pose(keyframe.index).compose(keyframe.odom_T_lidar.between(update.map_T_lidar))
            for keyframe in around
        ]
        if not poses:
            return update.map_T_lidar
        if len(poses) == 1 or after == 0:
            return poses[0]
        share = (update.stamp - around[0].stamp) / (around[1].stamp - around[0].stamp)
        step = gtsam.Pose3.Logmap(poses[0].between(poses[1]))
        return poses[0].compose(gtsam.Pose3.Expmap(share * step))

    def _known(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise InputError(f"keyframe: expected one of the {len(self)} there are, got {index}")
        return index


def _new_isam() -> gtsam.ISAM2:
    params = gtsam.ISAM2Params()
    params.relinearizeSkip = 1
    params.setRelinearizeThreshold(_RELINEARIZE)
    # Cholesky calls the chain of a second session, which hangs on a wide prior, indeterminate.
    params.setFactorization("QR")
    return gtsam.ISAM2(params)
