"""Pose graphs as files: g2o (Kuemmerle et al., ICRA 2011), and GTSAM's own serialisation.

g2o knows poses and motions between them; GTSAM's text archives know every factor. In a file, the
pose of keyframe ``i`` has the number ``i``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.datasets.decode.tables import whole_number
from loam_gtsam.errors import as_path
from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.loops.batch import SavedGraph
from loam_gtsam.loops.keyframes import is_pose, pose_key, pose_number
from loam_gtsam.loops.pose_graph import PoseGraph
from loam_gtsam.types import (
    MAX_STAMP,
    DatasetError,
    FloatArray,
    InputError,
    OutputError,
    check_kind,
)

G2O_SUFFIX, GTSAM_SUFFIXES = ".g2o", (".graph", ".values", ".stamps")
"""Suffixes of the files; GTSAM's format takes three files side by side."""

_POSE, _EDGE, _FIX, _STAMP = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "FIX", "# stamp_ns"
_NUMBERS = {_POSE: 8, _EDGE: 30, _FIX: 1}
_UPPER = np.triu_indices(6)
_SWAP = np.array([3, 4, 5, 0, 1, 2])  # order of the axes: g2o has translation first, GTSAM rotation
_FIXED_SIGMA = 1e-4
_NUMBERS_END = 1 << 56  # keys from here on are of ``gtsam.symbol``, smaller ones numbers of poses


def write_graph(path: str | Path, saved: SavedGraph | PoseGraph) -> None:
    """Write a graph: ``NAME.g2o``, or ``NAME.graph``, ``.values`` and ``.stamps`` for GTSAM.

    g2o holds poses and the motions between them only. Other factors and variables are left out, and
    poses that only such factors tie; a comment tells how many factors. The first pose is marked as
    fixed. Stamps go into comments.

    Raises
    ------
    InputError
        If the suffix is neither, or ``saved`` is no graph.
    OutputError
        If a file cannot be written, or the graph holds a factor that GTSAM cannot serialise.
    """
    path = as_path(path)
    saved = saved.saved() if isinstance(saved, PoseGraph) else saved
    check_kind(saved, SavedGraph, "saved", "RunResult.loops.graph is a PoseGraph, which will do")
    (_write_g2o if _is_g2o(path) else _write_gtsam)(path, saved)


def read_graph(path: str | Path) -> SavedGraph:
    """Read a graph that :func:`write_graph` wrote, or another system's g2o file of 3D poses.

    Raises
    ------
    InputError
        If the suffix is neither ``.g2o`` nor ``.graph``.
    DatasetError
        If the file cannot be read, naming the line that does not fit.
    """
    path = as_path(path)
    return _read_g2o(path) if _is_g2o(path) else _read_gtsam(path)


def _is_g2o(path: Path) -> bool:
    if path.suffix not in (G2O_SUFFIX, GTSAM_SUFFIXES[0]):
        raise InputError(
            f"{path}: expected a name that ends in {G2O_SUFFIX}, or in {GTSAM_SUFFIXES[0]} for "
            f"GTSAM's own format; got {path.suffix or 'none'}"
        )
    return path.suffix == G2O_SUFFIX


def _write_g2o(path: Path, saved: SavedGraph) -> None:
    lines = ["# made by loam_gtsam; information: translation first, then rotation (rad)"]
    stamps = {pose_number(key): stamp for key, stamp in saved.stamps.items()}
    lines += [f"{_STAMP} {number} {stamp}" for number, stamp in sorted(stamps.items())]
    factors = [saved.factors.at(place) for place in range(saved.factors.size())]
    motions = [factor for factor in factors if isinstance(factor, gtsam.BetweenFactorPose3)]
    others = [factor for factor in factors if not isinstance(factor, gtsam.BetweenFactorPose3)]
    loose = _keys(others) - _keys(motions)  # as the map on the earth: nothing in the file ties it
    every = {pose_number(key): key for key in saved.keys}
    ordered = sorted(every)
    numbers = [*ordered[:1], *(n for n in ordered[1:] if every[n] not in loose)]
    for number in numbers:
        lines.append(f"{_POSE} {number} {_pose_text(saved.poses.atPose3(every[number]))}")
    lines += [f"{_FIX} {number}" for number in numbers[:1]]
    for factor in motions:
        noise: Any = factor.noiseModel()
        if isinstance(noise, gtsam.noiseModel.Robust):
            noise = noise.noise()
        information = noise.information()[np.ix_(_SWAP, _SWAP)][_UPPER]
        first, second = map(pose_number, factor.keys())
        entries = " ".join(f"{value:.17g}" for value in information.tolist())
        lines.append(f"{_EDGE} {first} {second} {_pose_text(factor.measured())} {entries}")
    if others:
        lines.insert(1, f"# {len(others)} factors are left out, which g2o does not know")
    with atomic_file(path) as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))


def _keys(factors: Sequence[Any]) -> set[int]:
    return {key for factor in factors for key in factor.keys()}  # noqa: SIM118


def _pose_text(pose: gtsam.Pose3) -> str:
    q: Any = pose.rotation().toQuaternion()
    return " ".join(f"{v:.17g}" for v in [*pose.translation(), q.x(), q.y(), q.z(), q.w()])


def _read_g2o(path: Path) -> SavedGraph:
    graph, poses, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
    factors: list[tuple[str, list[int], FloatArray, str]] = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        where = f"{path}:{number}"
        tag, *fields = line.split() or ("#",)
        if line.startswith(_STAMP) and len(fields) == 3:
            stamps[_key(fields[1], where)] = _integer(fields[2], where, MAX_STAMP)
        if tag.startswith("#"):
            continue
        if tag not in _NUMBERS:
            raise DatasetError(
                f"{where}: expected {', '.join(_NUMBERS)} (poses in 3D and motions between them), "
                f"got {tag[:40]!r}"
            )
        if len(fields) != _NUMBERS[tag]:
            raise DatasetError(
                f"{where}: {tag} takes {_NUMBERS[tag]} numbers, this line has {len(fields)}"
            )
        keys = [_key(word, where) for word in fields[: 2 if tag == _EDGE else 1]]
        numbers = _floats(fields[len(keys) :], where)
        if tag != _POSE:
            factors.append((tag, keys, numbers, where))
        elif poses.exists(keys[0]):
            raise DatasetError(f"{where}: there already is a pose {pose_number(keys[0])}")
        else:
            poses.insert(keys[0], _pose(numbers, where))
    if poses.size() == 0:
        raise DatasetError(f"{path}: expected lines that begin with {_POSE}, found none")
    for tag, keys, numbers, where in sorted(factors, key=lambda factor: factor[0] == _EDGE):
        for key in keys:
            if not poses.exists(key):
                raise DatasetError(f"{where}: there is no {_POSE} {pose_number(key)}")
        if tag == _FIX:
            held = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
            graph.add(gtsam.PriorFactorPose3(keys[0], poses.atPose3(keys[0]), held))
            continue
        first, second = keys
        if first == second:
            raise DatasetError(f"{where}: expected a motion between two poses, got the same twice")
        noise = gtsam.noiseModel.Gaussian.Information(_information(numbers[7:], where))
        graph.add(gtsam.BetweenFactorPose3(first, second, _pose(numbers[:7], where), noise))
    return SavedGraph(graph, poses, {key: at for key, at in stamps.items() if poses.exists(key)})


def _pose(numbers: FloatArray, where: str) -> gtsam.Pose3:
    x, y, z, w = numbers[3:]
    length = float(np.linalg.norm(numbers[3:]))
    if not 0.99 < length < 1.01:
        raise DatasetError(f"{where}: expected a quaternion of length 1, got {length:.4g}")
    rotation = gtsam.Rot3.Quaternion(*(value / length for value in (w, x, y, z)))
    return gtsam.Pose3(rotation, numbers[:3])


def _information(upper: FloatArray, where: str) -> FloatArray:
    matrix = np.zeros((6, 6))
    matrix[_UPPER] = upper
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    least = float(np.linalg.eigvalsh(matrix)[0])
    if not least > 0.0:
        raise DatasetError(
            f"{where}: expected a positive definite information matrix, its least eigenvalue is "
            f"{least:.3g}"
        )
    swapped: FloatArray = matrix[np.ix_(_SWAP, _SWAP)]
    return swapped


def _integer(word: str, where: str, most: int) -> int:
    try:
        return whole_number(word, most=most)
    except ValueError:
        expected = f"expected a whole number of at most {most}"
        raise DatasetError(f"{where}: {expected}, got {word[:40]!r}") from None


def _key(word: str, where: str) -> int:
    number = _integer(word, where, (1 << 63) - 1)
    if number < 0:
        raise DatasetError(f"{where}: expected a number of a pose from 0 on, got {number}")
    return _key_of(number)


def _key_of(number: int) -> int:
    return pose_key(number) if number < _NUMBERS_END else number


def _floats(words: list[str], where: str) -> FloatArray:
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise DatasetError(f"{where}: {str(error)[:80]}") from None
    if not np.isfinite(numbers).all():
        raise DatasetError(f"{where}: expected finite numbers")
    return numbers


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error  # without the path again
        raise DatasetError(f"{path}: cannot read the graph: {reason}") from error


def _write_gtsam(path: Path, saved: SavedGraph) -> None:
    try:
        factors, poses = _renamed(saved.factors, saved.poses, pose_number)
        parts = [factors.serialize(), poses.serialize()]
    except RuntimeError as error:
        raise OutputError(
            f"{path}: GTSAM cannot serialise this graph ({error}); factors written in Python "
            "cannot be saved"
        ) from error
    stamps = sorted((pose_number(key), stamp) for key, stamp in saved.stamps.items())
    parts.append("".join(f"{number} {stamp}\n" for number, stamp in stamps))
    for suffix, text in zip(GTSAM_SUFFIXES, parts, strict=True):
        with atomic_file(path.with_suffix(suffix)) as file:
            file.write(text.encode("ascii"))


def _read_gtsam(path: Path) -> SavedGraph:
    graph, poses = gtsam.NonlinearFactorGraph(), gtsam.Values()
    targets: tuple[gtsam.NonlinearFactorGraph | gtsam.Values, ...] = (graph, poses)
    for suffix, target in zip(GTSAM_SUFFIXES[:2], targets, strict=True):
        part = path.with_suffix(suffix)
        text = _text(part)
        try:
            target.deserialize(text)
        except (RuntimeError, MemoryError) as error:
            raise DatasetError(
                f"{part}: not the text of a gtsam {type(target).__name__}: {error}"
            ) from error
    for key in poses.keys():  # noqa: SIM118 (no mapping)
        if key < _NUMBERS_END and not is_pose(poses, key):
            raise DatasetError(f"{path}: expected poses only, the variable {key} is none")
    # GTSAM reads the text of some other objects without an error, as an empty graph.
    known = set(poses.keys())
    for place in range(graph.size()):
        if not known.issuperset(graph.at(place).keys()):
            part = path.with_suffix(GTSAM_SUFFIXES[1])
            raise DatasetError(f"{part}: has no pose for factor {place} of {path}")
    graph, poses = _renamed(graph, poses, _key_of)
    stamps: dict[int, int] = {}
    part = path.with_suffix(GTSAM_SUFFIXES[2])
    if part.exists():
        for number, line in enumerate(_text(part).splitlines(), 1):
            words, where = line.split(), f"{part}:{number}"
            if len(words) != 2:
                raise DatasetError(f"{where}: expected a key and a stamp, got {line[:80]!r}")
            stamps[_key(words[0], where)] = _integer(words[1], where, MAX_STAMP)
    return SavedGraph(graph, poses, stamps)


def _renamed(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, rename: Callable[[int], int]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A copy of factors and values in which ``rename`` gives the keys of the poses."""
    graph, renamed = gtsam.NonlinearFactorGraph(), gtsam.Values(values)
    for key in values.keys():  # noqa: SIM118 (no mapping)
        if rename(key) != key:
            pose = values.atPose3(key)
            renamed.erase(key)
            renamed.insert(rename(key), pose)
    for place in range(factors.size()):
        factor: Any = factors.at(place)
        keys = list(factor.keys())
        new = list(map(rename, keys))
        graph.add(factor if new == keys else factor.rekey(new))
    return graph, renamed
