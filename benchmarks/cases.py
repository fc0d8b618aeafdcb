"""What is measured: the cases, and how one of them is run."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np

from benchmarks.peers import KissIcp, KissVariant, load, timed_points
from loam_gtsam.config import Config
from loam_gtsam.datasets import Dataset, Sweep, open_dataset
from loam_gtsam.datasets.bags.loam_topics import LoamTopicsDataset
from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.io.run_files import stage_seconds
from loam_gtsam.pipeline import RunResult, effective_config, run
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import DatasetError, FloatArray, MapUpdate, Scan, Trajectory

ROOT = Path(__file__).resolve().parents[1]
WORKERS = 1
"""Processes that extract features beside the one that maps: the peers use all cores, too."""
_BLOCK = 50
"""Sweeps that are mapped in one go; of them, two or three are extracted while peers run."""


def data_folder() -> Path:
    """Folder of the large data sets: ``LOAM_GTSAM_DATA``, else beside the repository."""
    return Path(os.environ.get("LOAM_GTSAM_DATA", ROOT.parent / "shared" / "data"))


@dataclass(frozen=True, slots=True)
class Case:
    """One run and what it is held against.

    Attributes
    ----------
    source : ``sim:...``, or a path below :func:`data_folder`
    frames : at most so many sweeps
    kiss : variants of KISS-ICP on the same sweeps; the first one is the yardstick for speed
    truth : TUM file below :func:`data_folder`; None is the data set's own
    ate_limit, ate_share, ms_limit, ratio_limit : targets: metres, share of the path, milliseconds
        a frame, times those of KISS-ICP
    rivals : labels of results whose ATE ours must not exceed
    known : ATE of other systems, measured elsewhere, metres
    note : what a reader must know
    """

    name: str
    source: str
    frames: int | None = None
    kiss: tuple[KissVariant, ...] = (KissVariant(),)
    truth: str | None = None
    ate_limit: float | None = None
    ate_share: float | None = None
    ms_limit: float | None = None
    ratio_limit: float | None = None
    rivals: tuple[str, ...] = ()
    known: tuple[tuple[str, float], ...] = ()
    note: str = ""

    @property
    def simulated(self) -> bool:
        """Whether the sweeps are made on the fly, which is not time of the pipeline."""
        return self.source.startswith("sim:")

    @property
    def missing(self) -> str:
        """The first of its files that is absent, or ""."""
        files = [self.truth] if self.simulated else [self.source, self.truth]
        paths = [data_folder() / file for file in files if file is not None]
        return next((str(path) for path in paths if not path.exists()), "")


NO_DESKEW = KissVariant("KISS-ICP, no de-skew", deskew=False)
CPP = "C++ on the same topics"

CASES: tuple[Case, ...] = (
    Case(
        "sim_town",
        "sim_town",
        kiss=(KissVariant(), NO_DESKEW),
        ate_limit=0.04,
        ms_limit=100.0,
        ratio_limit=1.0,
        known=(("A-LOAM on perfectly de-skewed sweeps", 0.045), ("loam_velodyne", 0.063)),
        note="simulated VLP-16, raw distorted sweeps, truth at the start of the sweep; the 0.27 m "
        "sometimes given for KISS-ICP hold its pose at the end of the sweep against the truth at "
        "the start",
    ),
    Case(
        "kitti_2011_09_26_0002",
        "kitti_2011_09_26_0002",
        kiss=(KissVariant(), NO_DESKEW),
        ate_limit=0.06,
        ms_limit=200.0,
        ratio_limit=1.0,
        rivals=("KISS-ICP", NO_DESKEW.label),
        note="HDL-64E, raw sweeps, truth from GPS/IMU; KISS-ICP as its loader of KITTI's raw data "
        "does it (elevation + 0.205 degrees, times from azimuth), and without de-skew. With it, "
        "most of its error is in the first sweeps: it starts in motion, and the first one stays "
        "distorted in its map",
    ),
    Case(
        "aloam_topics",
        "aloam_town/topics.bag",
        kiss=(),
        truth="sim_town/gt.tum",
        rivals=(CPP,),
        note="features and odometry recorded from A-LOAM on perfectly de-skewed sweeps",
    ),
    Case(
        "loam_topics",
        "loam_town/topics.bag",
        kiss=(),
        truth="sim_town/gt_end.tum",
        rivals=(CPP,),
        note="features and odometry recorded from loam_velodyne; poses at the end of the sweep",
    ),
    Case("street_loop", "sim:street_loop", ate_share=0.001, note="target: a path of 500 m or more"),
    Case("street_loop_1000", "sim:street_loop?frames=1000", ratio_limit=1.0),
    Case("room", "sim:room", note="KISS-ICP with its default voxel of 1 m, large for a room"),
    Case("corridor", "sim:corridor"),
    Case("trees", "sim:trees", frames=250),
    Case(
        "sparse_terrain",
        "sim:sparse_terrain",
        ate_limit=0.3,
        note="25 thin poles on waves of the ground, 300 m, and nothing else",
    ),
)

QUICK: tuple[Case, ...] = (
    Case("street_loop", "sim:street_loop", frames=40, note="40 sweeps only"),
    Case("room", "sim:room", frames=20, note="20 sweeps only"),
)


@dataclass(frozen=True, slots=True)
class Verdict:
    """A target and whether it was met (None: could not be judged)."""

    target: str
    met: bool | None

    def __str__(self) -> str:
        words = {True: "met", False: "NOT met", None: "not judged"}
        return f"{self.target}: {words[self.met]}"


@dataclass(frozen=True, slots=True)
class PeerResult:
    """ATE in metres and median milliseconds a frame of another system; NaN if not known."""

    label: str
    ate: float
    ms: float = float("nan")


@dataclass(frozen=True, slots=True)
class EvidenceTable:
    """Numbers to show, and to write as a CSV file of this name."""

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class CaseResult:
    """What one case gave; ``problem`` says why there is nothing else.

    Attributes
    ----------
    path : metres of the truth that was compared, else of our own trajectory
    ate : metres, SE(3)-aligned; NaN without truth
    stages : name -> (median, 95 %) milliseconds a frame; "wall" is the whole pipeline by the
        clock on the wall, in which the features of the next sweep are extracted meanwhile
    ratio : our median of that over KISS-ICP's, neither with reading; NaN without it
    map_points : edge and plane points of the whole map
    """

    name: str
    note: str = ""
    problem: str = ""
    failed: bool = False
    sweeps: int = 0
    path: float = float("nan")
    ate: float = float("nan")
    verdicts: tuple[Verdict, ...] = ()
    peers: tuple[PeerResult, ...] = ()
    stages: dict[str, tuple[float, float]] = field(default_factory=dict)
    ratio: float = float("nan")
    map_points: tuple[int, int] = (0, 0)
    statuses: dict[str, int] = field(default_factory=dict)
    tables: tuple[EvidenceTable, ...] = ()


class _Blocks:
    """Passes sweeps on from memory, a block at a time: making them is nobody's time."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self.name, self.sensor = dataset.name, dataset.sensor
        self.info, self.imu, self.truth = dataset.info, None, None
        self.passed: deque[Sweep] = deque()
        self.seconds = 0.0

    def __len__(self) -> int:
        return len(self._dataset)

    def __iter__(self) -> Iterator[Sweep]:
        sweeps = iter(self._dataset)
        while True:
            started = time.perf_counter()
            block = list(islice(sweeps, _BLOCK))
            self.seconds += time.perf_counter() - started
            if not block:
                return
            for sweep in block:
                self.passed.append(sweep)
                yield sweep


def open_case(case: Case) -> Dataset:
    """The data set of a case."""
    return open_dataset(case.source if case.simulated else data_folder() / case.source)


def run_case(case: Case, peers: bool = True) -> CaseResult:
    """Map the sweeps of a case, and let the peers map each block of them right after.

    Block by block, both have the whole machine, in the state it is in.

    Raises
    ------
    LoamError
        If the data cannot be read.
    """
    if case.missing:
        return CaseResult(case.name, case.note, problem="skipped: no data")
    dataset = open_case(case)
    # The peers have no IMU; what one brings is in `python -m benchmarks.worlds`.
    alone = Config().changed("imu.coupling=off")
    config = effective_config(alone, dataset)
    rivals = [KissIcp(v) for v in case.kiss] if peers and load("kiss_icp") is not None else []
    blocks = _Blocks(dataset)
    total = min(len(dataset), case.frames or len(dataset))
    done: list[Sweep] = []
    seconds: list[float] = []
    since = [0.0]

    def on_frame(number: int, update: MapUpdate) -> None:
        seconds.append(time.perf_counter() - blocks.seconds - since[0])
        done.append(blocks.passed.popleft())
        if len(done) == _BLOCK or number + 1 == total:
            for sweep in done:
                if isinstance(sweep, Scan):
                    points = timed_points(sweep, config)
                    for rival in rivals:
                        rival.register(sweep.stamp, points)
            done.clear()
        since[0] = time.perf_counter() - blocks.seconds

    result = run(blocks, config, max_frames=case.frames, on_frame=on_frame, workers=WORKERS)
    trajectory, recorded = result.trajectory, None
    truth = _truth(case, dataset, trajectory)
    if isinstance(dataset, LoamTopicsDataset) and dataset.recorded is not None:
        # The C++ systems publish a first pose before they have mapped anything.
        recorded = dataset.recorded[1:]
        trajectory = trajectory[np.isin(trajectory.stamps, recorded.stamps)]
    error = absolute_error(trajectory, truth)
    found = [
        PeerResult(
            rival.variant.label,
            absolute_error(rival.trajectory, truth).rmse,
            1e3 * float(np.median(rival.seconds)),
        )
        for rival in rivals
    ]
    if recorded is not None:
        found.append(PeerResult(CPP, absolute_error(recorded, truth).rmse))
    stages = stage_times(result)
    stages["wall"] = _median_and_tail(1e3 * np.array(seconds[1:]))  # without starting
    outcome = CaseResult(
        case.name,
        case.note,
        sweeps=len(result.updates),
        path=truth.at(error.stamps).path_length,
        ate=error.rmse,
        peers=(*found, *(PeerResult(f"{label} (known)", ate) for label, ate in case.known)),
        stages=stages,
        ratio=stages["wall"][0] / found[0].ms if rivals else float("nan"),
        map_points=(len(result.edge_points), len(result.plane_points)),
        statuses=result.status_counts,
    )
    return replace(outcome, verdicts=tuple(judge(case, outcome)))


def stage_times(result: RunResult) -> dict[str, tuple[float, float]]:
    """(median, 95 %) milliseconds a frame of each stage but reading."""
    names, seconds = stage_seconds(result.updates)
    columns = zip(names, seconds.T, strict=True)
    return {name: _median_and_tail(1e3 * column) for name, column in columns if name != "read"}


def judge(case: Case, outcome: CaseResult) -> Iterator[Verdict]:
    """Hold a result against the targets of its case."""
    if case.ate_limit is not None:
        yield Verdict(f"ATE <= {case.ate_limit:g} m", outcome.ate <= case.ate_limit)
    if case.ate_share is not None:
        short = outcome.ate < case.ate_share * outcome.path
        yield Verdict(f"ATE < {100.0 * case.ate_share:g} % of the path", short)
    if case.ms_limit is not None:
        fast = outcome.stages["wall"][0] <= case.ms_limit
        yield Verdict(f"<= {case.ms_limit:g} ms a frame", fast)
    if case.ratio_limit is not None:
        met = None if np.isnan(outcome.ratio) else outcome.ratio <= case.ratio_limit
        yield Verdict(f"<= {case.ratio_limit:g} x KISS-ICP", met)
    measured = {peer.label: peer.ate for peer in outcome.peers}
    for label in case.rivals:
        ate = measured.get(label)
        yield Verdict(f"ATE <= {label}", None if ate is None else outcome.ate <= ate)


def _truth(case: Case, dataset: Dataset, trajectory: Trajectory) -> Trajectory:
    """Reference poses in the clock of the run."""
    truth = dataset.truth
    if case.truth is not None:
        truth = read_tum(data_folder() / case.truth)
        # The bags were stamped a whole number of seconds later than the files.
        offset = round((int(trajectory.stamps[0]) - int(truth.stamps[0])) * 1e-9) * 10**9
        truth = Trajectory(truth.stamps + offset, truth.map_T_lidar)
    if truth is None:
        raise DatasetError(f"{case.name}: {case.source} comes without reference poses")
    return truth


def _median_and_tail(column: FloatArray) -> tuple[float, float]:
    ran = column[~np.isnan(column)]
    return float(np.median(ran)), float(np.percentile(ran, 95.0))
