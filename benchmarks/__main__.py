"""Run the benchmarks: ``python -m benchmarks`` from the root of the repository."""

from __future__ import annotations

import argparse
import cProfile
import io
import pstats
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks import history, ouster, report
from benchmarks.cases import CASES, QUICK, ROOT, Case, CaseResult, open_case, run_case
from loam_gtsam.datasets.kitti.folder import KittiDataset
from loam_gtsam.pipeline import run
from loam_gtsam.types import LoamError

NAMES = (*(case.name for case in CASES), ouster.NAME)
_WIDTH = 200
"""Columns when the output is no terminal; the tables are wide."""
_LINES = 30
"""Functions in a profile."""


def benchmark(
    cases: Sequence[Case],
    *,
    with_ouster: bool = False,
    peers: bool = True,
    announce: Callable[[str], None] = lambda name: None,
) -> list[CaseResult]:
    """Run cases one after the other; one that fails does not cost the others."""
    jobs: list[tuple[str, Callable[[], CaseResult]]] = [
        (case.name, partial(run_case, case, peers)) for case in cases
    ]
    if with_ouster:
        jobs.append((ouster.NAME, partial(ouster.run_case, peers)))
    results = []
    for name, job in jobs:
        announce(name)
        try:
            results.append(job())
        except LoamError as error:
            results.append(CaseResult(name, problem=f"failed: {error}", failed=True))
    return results


def profile(name: str, folder: Path) -> tuple[Path, str]:
    """Profile one case without peers; the file and its text, most time in itself first."""
    case = next((case for case in CASES if case.name == name), None)
    if case is not None and case.missing:
        raise LoamError(f"{name}: {case.missing} is missing; set LOAM_GTSAM_DATA")
    dataset = open_case(case) if case is not None else KittiDataset(ouster.FOLDER)
    profiler = cProfile.Profile()
    profiler.runcall(run, dataset, max_frames=case.frames if case is not None else None)
    out = io.StringIO()
    stats = pstats.Stats(profiler, stream=out).strip_dirs().sort_stats("tottime")
    stats.print_stats(_LINES)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"profile_{name}.txt"
    path.write_text(out.getvalue(), encoding="utf-8")
    return path, out.getvalue()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 1 if a case failed (a missed target or absent data is no failure)."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few sweeps of built-in data")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=NAMES, default=NAMES,
                        help=f"cases to run: {', '.join(NAMES)}")  # fmt: skip
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results",
                        help="folder for the tables, as CSV files, and the history")  # fmt: skip
    parser.add_argument("--no-peers", action="store_true", help="without KISS-ICP and small_gicp")
    parser.add_argument("--profile", metavar="CASE", choices=NAMES,
                        help="profile one case instead")  # fmt: skip
    options = parser.parse_args(arguments)
    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH)
    if options.profile is not None:
        try:
            path, text = profile(options.profile, options.output)
        except LoamError as error:
            console.print(str(error), markup=False)
            return 1
        console.print(text, markup=False, highlight=False)
        console.print(f"Written to {path}", markup=False, soft_wrap=True)
        return 0
    results = benchmark(
        [case for case in (QUICK if options.quick else CASES) if case.name in options.only],
        with_ouster=ouster.NAME in options.only,
        peers=not options.no_peers,
        announce=lambda name: console.print(f"{name} ..."),
    )
    report.show(console, report.tables(results))
    paths = report.write(options.output, results)
    if not options.quick:
        paths += history.add(options.output, results)
    console.print(f"Written: {', '.join(map(str, paths))}", markup=False, soft_wrap=True)
    return int(any(result.failed for result in results))


if __name__ == "__main__":
    sys.exit(main())
