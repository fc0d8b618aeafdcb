"""Damage files of every format and parameters without guidance, for as long as you like.

python tests/fuzz/mutate.py --files 1250 --values 10000
python tests/fuzz/mutate.py --only "ros1 bz2" --first 117 --files 1

Every mutant must give data or a LoamError within ten seconds and 4 GB. What does not is printed,
with its number, once for every place in the code, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import multiprocessing
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from specimens import Specimen, all_specimens
from support.strategies import STEP_KINDS, STEP_NUMBERS, STEP_SIZES, TOKENS, mutated, replaced

from loam_gtsam import config
from loam_gtsam.config import Config
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.pipeline import run
from loam_gtsam.types import LoamError

_SECONDS, _MEMORY = 10, 4 << 30
_EXTREMES = ["0", "-1", "1", "2", "7", "1e-300", "1e-9", "0.5", "1e6", "1e9", "1e18", "1e300",
             ".inf", "-.inf", ".nan", str(2**31), str(2**63), "9" * 400, "null", "''", "[]", "{}",
             "[0, 0, 0]", "[1e300, 1, 1]", "true", "auto", "x"]  # fmt: skip
CONTENT = "a bare exception, or too much time or memory"


class HangError(Exception):
    """Time is up."""


def damage(content: bytes, chance: random.Random) -> bytes:
    """A file in which words were replaced, or whose bytes were mutated."""
    if b"\0" not in content and chance.random() < 0.5:
        words = [(chance.random(), chance.choice(TOKENS)) for _ in range(chance.randint(1, 3))]
        return replaced(content.decode("latin1"), words)
    steps = [
        (
            chance.choice(STEP_KINDS),
            chance.random(),
            chance.choice(STEP_SIZES),
            chance.choice([chance.choice(STEP_NUMBERS), chance.randint(0, 255)]),
        )
        for _ in range(chance.randint(1, 4))
    ]
    return mutated(content, steps)


def read_mutant(specimen: Specimen, chance: random.Random | None) -> None:
    """Write the files, one of them damaged unless there is no chance of it, and read them."""
    files = dict(specimen.files)
    if chance is not None:
        victim = chance.choice(sorted(files))
        files[victim] = damage(files[victim], chance)
    folder = Path(tempfile.mkdtemp(prefix="mutant_"))
    try:
        for name, content in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        specimen.read(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def parameters() -> list[tuple[str, Any]]:
    """All parameters by name, with their fields."""
    return [
        (f"{name}.{key}", field)
        for name, section in Config()
        for key, field in type(section).model_fields.items()
    ]


def value(field: Any, chance: random.Random) -> str:
    """A value as YAML writes it: an extreme one, one at or beside a bound, or one in between."""
    bounds = [getattr(m, side) for m in field.metadata for side in ("ge", "le") if hasattr(m, side)]
    kind = chance.random()
    if kind < 0.4 or not bounds:
        choices = [str(choice) for choice in get_args(field.annotation)]
        return chance.choice(_EXTREMES + choices)
    whole = isinstance(field.default, int) and not isinstance(field.default, bool)
    if kind < 0.7:
        bound = chance.choice(bounds)
        moved = bound + chance.choice([0, 0, 1, -1]) * (1 if whole else 1e-9)
        return str(int(moved) if whole else float(moved))
    low, high = min(bounds), max(bounds)
    between = max(low, 1e-9) * (max(high, 1e-6) / max(low, 1e-9)) ** chance.random()
    return str(int(between) if whole else between)


def run_with(values: list[str]) -> None:
    """A few sweeps with an IMU and loops, if the values are accepted."""
    changes = {"loops.enabled": True, "pose_graph.keyframe_distance": 0.001}
    changed = Config().changed(changes).changed(*values).changed({"map.archive_dir": None})
    run(WORLD, changed)


WORLD = SimulatedWorld("room", frames=5, columns=60, imu="mems", start="moving", speed=3.0)


def try_value(chance: random.Random | None) -> None:
    """One to three parameters at once, or none."""
    if chance is None:
        return run_with([])
    names = chance.sample(parameters(), chance.choice([1, 1, 2, 3]))
    values = [f"{name}={value(field, chance)}" for name, field in names]
    try:
        run_with(values)
    except LoamError:
        raise
    except BaseException as error:
        error.add_note(str(values)[:300])
        raise


def attempt(name: str, number: int, seed: int, target: Callable[[random.Random], None]) -> str:
    """What was found; empty if the mutant gave data or a LoamError."""
    started = time.process_time()
    signal.alarm(6 * _SECONDS)
    try:
        target(random.Random(f"{seed} {name} {number}"))
    except LoamError as error:
        if len(str(error)) > 5_000:
            return f"a message of {len(str(error))} letters"
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if "loam_gtsam" in f.filename]
        notes = getattr(error, "__notes__", [])
        return f"{type(error).__name__}: {str(error)[:200]} at {' < '.join(ours[:-4:-1])} {notes}"
    finally:
        signal.alarm(0)
    took = time.process_time() - started
    return f"{took:.0f} s" if took > _SECONDS else ""


def _ring(*_: object) -> None:
    raise HangError("time is up")


def batch(
    name: str, target: Any, numbers: range, seed: int, done: Any, found: Any
) -> None:  # in a process of its own
    """Mutants of one format, one after the other."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    signal.signal(signal.SIGALRM, _ring)
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", RuntimeWarning)
    target(None)  # mutants of what is refused anyway would show nothing
    for number in numbers:
        done.value = number
        problem = attempt(name, number, seed, target)
        if problem:
            found.put((number, problem))
    done.value = numbers.stop


def all_of(name: str, target: Any, numbers: range, seed: int) -> int:
    """Number of findings in a format; a process that dies is another one, and the rest follows."""
    context = multiprocessing.get_context("fork")
    seen: Counter[str] = Counter()

    def take(number: int, problem: str) -> None:
        place = problem.partition(" at ")[2].partition(" [")[0] or problem.partition(":")[0]
        if not seen[place]:
            print(f"  {number}: {problem}", flush=True)
        seen[place] += 1

    while len(numbers):
        done, found = context.Value("q", -1), context.SimpleQueue()
        process = context.Process(
            target=batch, args=(name, target, numbers, seed, done, found), daemon=True
        )
        process.start()
        while process.is_alive():
            process.join(0.2)
            while not found.empty():
                take(*found.get())
        while not found.empty():
            take(*found.get())
        if done.value >= numbers.stop:
            break
        if done.value < 0:
            raise SystemExit(f"{name}: refused though nothing is damaged")
        take(done.value, f"the process died: exit code {process.exitcode}")
        numbers = range(done.value + 1, numbers.stop)
    return seen.total()


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=1250, help="of each format")
    parser.add_argument("--values", type=int, default=10_000, help="of parameters")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="this format, or 'values'")
    options = parser.parse_args()
    assert config.__name__  # imported before the processes are forked
    jobs: dict[str, tuple[Any, int]] = {}
    for name, specimen in all_specimens().items():
        jobs[name] = (lambda chance, s=specimen: read_mutant(s, chance)), options.files
    jobs["values"] = try_value, options.values
    totals: Counter[str] = Counter()
    for name, (target, count) in jobs.items():
        if options.only not in (None, name):
            continue
        started = time.monotonic()
        numbers = range(options.first, options.first + count)
        findings = all_of(name, target, numbers, options.seed)
        totals.update(mutants=count, findings=findings)
        seconds = time.monotonic() - started
        print(f"{name}: {count}, {findings} findings, {seconds:.0f} s", flush=True)
    print(f"{totals['mutants']} mutants, {totals['findings']} findings ({CONTENT})")
    return int(totals["findings"] > 0)


if __name__ == "__main__":
    sys.exit(main())
