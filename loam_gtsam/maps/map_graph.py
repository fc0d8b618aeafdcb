"""The pose graph of a saved map: its places, the motions between them, and loop closures.

In a file motions, the fixes of GNSS receivers and a user's own factors are arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from loam_gtsam.aiding.placed_fixes import PlacedFixes
from loam_gtsam.config import Config, LoopConfig
from loam_gtsam.geometry import nearest_positive, symmetric, transform
from loam_gtsam.loops.batch import SavedGraph
from loam_gtsam.loops.keyframes import Keyframe, LoopClosure, pose_key, pose_number, walk
from loam_gtsam.loops.map_correction import LoopMapping
from loam_gtsam.loops.places import Place
from loam_gtsam.loops.scan_context import scan_context
from loam_gtsam.maps.linear_factors import NUMBER, LinearFactors
from loam_gtsam.types import FloatArray, stack_poses

PARTS = "places", "links", "loops", "fixes", "receivers", "own_variables", "own_blocks", "own_rows"
"""What a graph has a number of, by which :func:`array_shapes` knows its arrays."""
_PLACES = "stamps", "map_T_middle", "covariances", "descriptors"
_MOTIONS = "ends", "motions", "covariances"
_FIXES = (
    "places", "place_T_lidar", "enu", "covariances", "receivers", "antennas", "antenna_sigmas",
)  # fmt: skip
"""What the fields of :class:`PlacedFixes` are called in a file, in their order."""


@dataclass(frozen=True, slots=True, eq=False)
class MapGraph:
    """Places of a map, by their numbers, and what leads from one to another.

    Attributes
    ----------
    places : where the map can be recognised
    links : motions along the runs, from place to place, without the walk of ``pose_graph`` in their
        covariances; a place that none leads to begins a run
    loops : loop closures that were used
    fixes : those of GNSS receivers that were used, by numbers of places; None if there are none
    own : a user's own factors; None if there are none
    """

    places: Sequence[Place]
    links: Sequence[LoopClosure]
    loops: Sequence[LoopClosure]
    fixes: PlacedFixes | None = None
    own: LinearFactors | None = None

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of its :data:`PARTS`."""
        fixes = ((), ()) if self.fixes is None else (self.fixes, self.fixes.antennas)
        own = ((),) * 3 if self.own is None else (self.own.places, self.own.rows, self.own.right)
        every = self.places, self.links, self.loops, *fixes, *own
        return dict(zip(PARTS, map(len, every), strict=True))

    def saved(self) -> SavedGraph:
        """As it is written to other files: links, then loops, and nothing else."""
        factors, poses = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for motion in (*self.links, *self.loops):
            factors.add(motion.factor())
        for number, place in enumerate(self.places):
            poses.insert(pose_key(number), place.map_T_middle)
        stamps = {pose_key(number): place.stamp for number, place in enumerate(self.places)}
        first = len(self.links)
        return SavedGraph(factors, poses, stamps, range(first, first + len(self.loops)))

    def held(self) -> SavedGraph:
        """As it is optimised: the first place is held, and a user's own factors are there."""
        graph = self.saved()
        if self.places:
            begin = self.places[0]
            graph.factors.add(gtsam.PriorFactorPose3(pose_key(0), begin.map_T_middle, begin.noise))
        if self.own is not None:
            graph.factors.push_back(self.own.factors())
            graph.poses.insert(self.own.start())
        return graph


def graph_of(mapping: LoopMapping, config: Config, fixes: PlacedFixes | None = None) -> MapGraph:
    """The keyframes of a run with loops as places, where its graph has them.

    ``fixes`` are those that were used, by numbers of keyframes.
    """
    graph = mapping.graph
    places, moves = [], {}
    for number, keyframe in enumerate(graph.keyframes):
        pose = graph.pose(keyframe.index)
        move = _to_middle(keyframe)
        to_map = pose.AdjointMap()
        covariance = symmetric(to_map @ graph.covariance(keyframe.index) @ to_map.T)
        points = np.concatenate([keyframe.edges, keyframe.planes])
        seen = transform(move.inverse().matrix(), points)
        descriptor = scan_context(seen, config.loops).astype(np.float16)
        places.append(Place(keyframe.stamp, pose.compose(move), covariance, descriptor))
        moves[keyframe.index] = number, move
    factors, own = graph.saved().factors, gtsam.NonlinearFactorGraph()
    links, added = [], set(graph.own)
    for place in range(factors.size() - len(graph.loops)):
        factor: Any = factors.at(place)
        if place in added:
            own.add(factor)
            continue
        if not isinstance(factor, gtsam.BetweenFactorPose3):
            continue
        (one, two), noise = map(pose_number, factor.keys()), factor.noiseModel()
        if one in moves and two in moves and isinstance(noise, gtsam.noiseModel.Gaussian):
            first, second = graph.keyframe(one), graph.keyframe(two)
            told = walk(abs(second.travelled - first.travelled), config.pose_graph)
            measured = nearest_positive(noise.covariance() - told)
            motion = LoopClosure(one, two, factor.measured(), measured)
            links.append(_between_middles(motion, moves))
    active = zip(graph.loops, graph.active, strict=True)
    loops = [_between_middles(loop, moves) for loop, on in active if on]
    placed = None if fixes is None else fixes.seen_from(moves)
    linear = LinearFactors.of(own, graph.values, moves) if own.size() else None
    return MapGraph(places, links, loops, placed, linear)


def _to_middle(keyframe: Keyframe) -> gtsam.Pose3:
    """The middle of the sweep of a keyframe, seen from its reference time."""
    middle = keyframe.update.map_T_middle
    return gtsam.Pose3() if middle is None else keyframe.odom_T_lidar.between(middle)


def _between_middles(
    motion: LoopClosure, moves: Mapping[int, tuple[int, gtsam.Pose3]]
) -> LoopClosure:
    """A motion between keyframes as one between the middles of their sweeps."""
    (one, first), (two, second) = moves[motion.earlier], moves[motion.later]
    moved = first.between(motion.earlier_T_later).compose(second)
    back = second.inverse().AdjointMap()
    covariance = symmetric(back @ motion.covariance @ back.T)
    return LoopClosure(one, two, moved, covariance, motion.share, motion.agreement)


def array_shapes(
    sizes: Mapping[str, int], config: LoopConfig
) -> dict[str, tuple[np.dtype[Any], tuple[int, ...]]]:
    """Types and shapes of the arrays of a graph, by name, from the numbers of its parts."""
    whole, real = np.dtype("<i8"), np.dtype("<f8")
    places = sizes["places"]
    shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {
        "places/stamps": (whole, (places,)),
        "places/map_T_middle": (real, (places, 4, 4)),
        "places/covariances": (real, (places, 6, 6)),
        "places/descriptors": (np.dtype("<f2"), (places, config.rings, config.sectors)),
    }
    for kind in ("links", "loops"):
        count = sizes[kind]
        shapes |= {
            f"{kind}/ends": (whole, (count, 2)),
            f"{kind}/motions": (real, (count, 4, 4)),
            f"{kind}/covariances": (real, (count, 6, 6)),
        }
    if count := sizes["fixes"]:
        shapes |= {
            "fixes/places": (whole, (count,)),
            "fixes/place_T_lidar": (real, (count, 4, 4)),
            "fixes/enu": (real, (count, 3)),
            "fixes/covariances": (real, (count, 3, 3)),
            "fixes/receivers": (whole, (count,)),
            "fixes/antennas": (real, (sizes["receivers"], 3)),
            "fixes/antenna_sigmas": (real, (sizes["receivers"],)),
        }
    if rows := sizes["own_rows"]:
        variables, blocks = sizes["own_variables"], sizes["own_blocks"]
        shapes |= {
            "own/places": (whole, (variables,)),
            "own/at": (real, (variables, 4, 4)),
            "own/rows": (whole, (blocks,)),
            "own/variables": (whole, (blocks,)),
            "own/blocks": (real, (blocks, 6)),
            "own/right": (real, (rows,)),
        }
    return shapes


def graph_arrays(graph: MapGraph, config: LoopConfig) -> dict[str, NDArray[Any]]:
    """A graph as arrays, by name; see :func:`array_shapes`."""
    places = graph.places
    descriptors = np.array([place.descriptor for place in places], np.float16)
    arrays: dict[str, NDArray[Any]] = {
        "places/stamps": np.array([place.stamp for place in places], np.int64),
        "places/map_T_middle": stack_poses(place.map_T_middle for place in places),
        "places/covariances": _matrices([place.covariance for place in places]),
        "places/descriptors": descriptors.reshape(-1, config.rings, config.sectors),
    }
    for kind, motions in (("links", graph.links), ("loops", graph.loops)):
        ends = np.array([(one.earlier, one.later) for one in motions], np.int64)
        arrays |= {
            f"{kind}/ends": ends.reshape(-1, 2),
            f"{kind}/motions": stack_poses(one.earlier_T_later for one in motions),
            f"{kind}/covariances": _matrices([one.covariance for one in motions]),
        }
    if graph.fixes is not None and len(graph.fixes):
        columns = zip(_FIXES, fields(PlacedFixes), strict=True)
        arrays |= {f"fixes/{name}": getattr(graph.fixes, one.name) for name, one in columns}
    if graph.own is not None and len(graph.own.right):
        arrays |= {f"own/{one.name}": getattr(graph.own, one.name) for one in fields(LinearFactors)}
    return arrays


def graph_of_arrays(arrays: Mapping[str, NDArray[Any]]) -> MapGraph:
    """The graph of arrays.

    Raises
    ------
    ValueError
        If a motion is between places that there are not, or a fix or a factor is on such a place,
        or if what a fix has for a covariance is none.
    """
    columns = (arrays[f"places/{name}"] for name in _PLACES)
    places = [
        Place(int(stamp), gtsam.Pose3(pose), covariance, descriptor)
        for stamp, pose, covariance, descriptor in zip(*columns, strict=True)
    ]
    found = []
    for kind in ("links", "loops"):
        ends, motions, covariances = (arrays[f"{kind}/{name}"] for name in _MOTIONS)
        if ((ends < 0) | (ends >= len(places))).any():
            raise ValueError(f"{kind}/ends.npy: expected numbers of the {len(places)} places")
        rows = zip(*ends.T.tolist(), map(gtsam.Pose3, motions), covariances, strict=True)
        found.append([LoopClosure(*row) for row in rows])
    links, loops = found
    fixes = _fixes_of_arrays(arrays, len(places)) if "fixes/places" in arrays else None
    own = _own_of_arrays(arrays, len(places)) if "own/places" in arrays else None
    return MapGraph(places, links, loops, fixes, own)


def _fixes_of_arrays(arrays: Mapping[str, NDArray[Any]], places: int) -> PlacedFixes:
    fixes = PlacedFixes(*(arrays[f"fixes/{name}"] for name in _FIXES))
    for name, numbers, count in (
        ("places", fixes.poses, places),
        ("receivers", fixes.receivers, len(fixes.antennas)),
    ):
        if ((numbers < 0) | (numbers >= count)).any():
            raise ValueError(f"fixes/{name}.npy: expected numbers of the {count} {name}")
    spreads = np.linalg.eigvalsh(fixes.covariances)
    if not ((spreads > 0.0).all() and (fixes.antenna_sigmas > 0.0).all()):
        raise ValueError("fixes/covariances.npy, antenna_sigmas.npy: expected variances above 0")
    return fixes


def _own_of_arrays(arrays: Mapping[str, NDArray[Any]], places: int) -> LinearFactors:
    own = LinearFactors(*(arrays[f"own/{one.name}"] for one in fields(LinearFactors)))
    for name, numbers, first, count in (
        ("places", own.places, NUMBER, places),
        ("variables", own.variables, 0, len(own.places)),
    ):
        if ((numbers < first) | (numbers >= count)).any():
            raise ValueError(f"own/{name}.npy: expected numbers from {first} to {count - 1}")
    if not np.array_equal(np.unique(own.rows), np.arange(len(own.right))):
        raise ValueError(f"own/rows.npy: expected numbers of all {len(own.right)} rows")
    if (np.diff(own.rows) < 0).any():
        raise ValueError("own/rows.npy: expected numbers of rows in their order")
    return own


def _matrices(given: Sequence[FloatArray]) -> FloatArray:
    return np.array(given, np.float64).reshape(-1, 6, 6)
