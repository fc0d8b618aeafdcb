"""What untrusted input must not do: run code, take memory it only claims, or choose paths."""

from __future__ import annotations

import ast
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import START, cloud, imu, make_message, store_of, write_bag, xyz
from support.cli import loam
from support.quick import QUICK_START

from loam_gtsam.config import BagConfig, MapConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.datasets import SimulatedWorld, open_dataset
from loam_gtsam.datasets.decode.pointcloud2 import decode_pointcloud2
from loam_gtsam.ros.bag_writer import BagWriter
from loam_gtsam.types import BadSweep, DatasetError, LoamError, OutputError

ROOT = Path(__file__).resolve().parents[2] / "loam_gtsam"

# -- code ------------------------------------------------------------------------------------------

MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib", "code"}
CALLS = {
    "eval", "exec", "compile", "__import__", "os.system", "os.popen", "np.fromstring",
    "numpy.fromstring", "yaml.load", "yaml.unsafe_load", "tempfile.mktemp", "shutil.unpack_archive",
}  # fmt: skip


def unsafe_in(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """What could run code that came with data, as (what, line)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] in MODULES:
                    yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            if (node.module or "").split(".")[0] in MODULES:
                yield str(node.module), node.lineno
            for alias in node.names:
                if f"{node.module}.{alias.name}" in CALLS:
                    yield f"{node.module}.{alias.name}", node.lineno
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            options = {word.arg: ast.unparse(word.value) for word in node.keywords}
            if called in CALLS or called.endswith((".extractall", ".from_pickle")):
                yield called, node.lineno
            if options.get("shell", "False") != "False":
                yield f"{called}(shell=...)", node.lineno
            if called in ("np.load", "numpy.load") and options.get("allow_pickle") != "False":
                yield f"{called} without allow_pickle=False", node.lineno
            kind = options.get("typ", ast.unparse(node.args[0]) if node.args else "'rt'")
            if called.endswith("YAML") and kind not in ("'rt'", "'safe'"):
                yield f"YAML(typ={kind})", node.lineno


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: path.stem)
def test_no_code_comes_with_data(path: Path) -> None:
    found = list(unsafe_in(ast.parse(path.read_text(encoding="utf-8"))))
    if path.name == "workers.py":  # it exchanges values with processes of its own only
        found = [what for what in found if what[0] != "pickle"]
    assert not found, f"{path.name}: {found}; data must not be able to run code"


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("import pickle", 1),
        ("from marshal import loads", 1),
        ("from os import system", 1),
        ("def f():\n    eval('1')", 1),
        ("os.system('ls')", 1),
        ("subprocess.run('ls', shell=True)", 1),
        ("np.load(path)", 1),
        ("np.load(path, allow_pickle=True)", 1),
        ("np.load(path, allow_pickle=False)", 0),
        ("YAML(typ='unsafe')", 1),
        ("YAML('unsafe')", 1),
        ("YAML(typ='safe')\nYAML()", 0),
        ("re.compile('x')\nmodel.eval()\ndef literal_eval(): pass", 0),
        ("zip.extractall(there)", 1),
    ],
)
def test_every_way_to_run_code_is_seen(code: str, count: int) -> None:
    assert len(list(unsafe_in(ast.parse(code)))) == count


# -- sizes -----------------------------------------------------------------------------------------


def most_memory(call: Any) -> int:
    """Bytes that a call took at most beyond what there was."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


HUGE = 2**31


@pytest.mark.parametrize(
    "sizes",
    [
        {"width": HUGE, "row_step": 0},
        {"width": HUGE, "row_step": 2**32 - 1},
        {"height": HUGE, "width": 1},
        {"height": HUGE, "width": HUGE, "row_step": 0},
        {"height": HUGE, "width": 1, "row_step": 2**32 - 1},
        {"point_step": 2**32 - 1, "row_step": 0},
        {"height": HUGE, "width": 0},
    ],
    ids=str,
)
def test_a_cloud_that_claims_two_thousand_million_points_takes_no_memory(
    sizes: dict[str, int],
) -> None:
    message = make_message({**xyz(), "ring": np.zeros(400, "u2"), "t": np.zeros(400, "u4")})
    for name, value in sizes.items():
        setattr(message, name, value)

    def decode() -> None:
        with suppress(DatasetError):
            assert len(decode_pointcloud2(message).points) == 0

    assert most_memory(decode) < 200_000


@pytest.mark.parametrize("count", [HUGE, 2**32 - 1])
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("what", ["fields", "data"])
def test_a_message_that_claims_a_long_array_takes_no_memory(
    tmp_path: Path, kind: str, what: str, count: int
) -> None:
    store = store_of(kind)
    message = cloud(store, START, np.ones((20, 3)))
    serialise = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    raw = bytearray(serialise(message, message.__msgtype__))
    length = len(message.fields) if what == "fields" else len(message.data)
    known = length.to_bytes(4, "little") + (b"" if what == "fields" else bytes(message.data)[:8])
    at = raw.index(known)
    raw[at : at + 4] = count.to_bytes(4, "little")
    recording = [
        ("/points", START + i, entry) for i, entry in enumerate([message, bytes(raw), message])
    ]
    dataset = open_dataset(write_bag(tmp_path / "run", kind, recording))
    sweeps: list[Any] = []
    assert most_memory(lambda: sweeps.extend(dataset)) < 5_000_000
    assert [isinstance(sweep, BadSweep) for sweep in sweeps] == [False, True, False]


def test_an_archived_cube_that_claims_more_than_its_file_holds_is_dropped(tmp_path: Path) -> None:
    config = MapConfig(
        cube_size=4.0, window=(3, 3, 3), window_margin=1, neighbourhood=(3, 3, 3),
        archive_megabytes=0.0, archive_dir=str(tmp_path),
    )  # fmt: skip
    cubes = CubeMap(config, 0.5)
    cubes.insert(np.ones((1, 3)))
    cubes.recenter(np.array([40.0, 0.0, 0.0]))
    (file,) = tmp_path.rglob("*.npy")
    content = file.read_bytes()
    for shape in (b"(2147483648, 5), }", b"(99999999999999, 5), }"):
        claim = content.replace(b"(1, 5), }", shape)
        file.write_bytes(claim[: len(content) - len(shape) + 9] + claim[-40:])
    assert most_memory(lambda: cubes.recenter(np.zeros(3))) < 10_000_000
    assert cubes.stats.dropped_cubes == 1
    assert cubes.count() == 0


# -- paths -----------------------------------------------------------------------------------------


def files_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


EVIL = ["../../evil", "/a/../../../evil", "~/evil", "/[/evil]", "/$(evil)", "/\x1b[2Jevil"]


@pytest.mark.parametrize("topic", ["/../../evil", "/etc/[/evil]"])
def test_names_in_a_bag_never_become_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topic: str
) -> None:
    here = tmp_path / "a" / "b"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    monkeypatch.setenv("HOME", str(tmp_path))
    store = store_of("mcap")
    recording = []
    for scan in SimulatedWorld("room", frames=2, columns=180, sensor="vlp16"):
        assert scan.rings is not None
        assert scan.times is not None
        columns = {"ring": scan.rings.astype("u2"), "time": scan.times.astype("f4")}
        message = cloud(store, scan.stamp, scan.points, **columns)
        named = replace(message.header, frame_id=topic)
        recording.append((topic, scan.stamp, replace(message, header=named)))
        recording += [(name, scan.stamp, imu(store, scan.stamp)) for name in EVIL]
    write_bag(here / "run", "mcap", recording)
    before = files_below(tmp_path)
    assert loam("inspect", "run", *QUICK_START).exit_code == 0
    archive = f"map.archive_dir={here / 'archive'}"
    result = loam(
        "run", "run", "--output", "out", "--bag", "mapped.bag", "--set", archive, "--set",
        "map.archive_megabytes=0", "--no-plot", *QUICK_START,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    compare = "compare", "run", "--solver", "gtsam", "--output", "both", "--no-plot"
    assert loam(*compare, *QUICK_START).exit_code == 0
    made = files_below(tmp_path) - before
    assert made
    told = ("a/b/out/", "a/b/both/", "a/b/archive/", "a/b/mapped.bag")
    assert all(name.startswith(told) for name in made), made


def test_a_frame_name_with_dots_and_slashes_stays_inside_the_bag(tmp_path: Path) -> None:
    config = BagConfig(map_frame="../../map", lidar_frame="/etc/lidar")
    inside = tmp_path / "inside"
    inside.mkdir()
    from loam_gtsam.pipeline import run

    world = SimulatedWorld("room", frames=2, columns=180, sensor="vlp16")
    with BagWriter(inside / "mapped", config) as bag:
        for update in run(world).updates:
            bag.write(update)
    assert {name.split("/")[0] for name in files_below(tmp_path)} == {"inside"}


@pytest.mark.parametrize("place", ["../outside.db3", "/outside.db3", "nothing/../../outside.db3"])
def test_a_folder_reads_no_file_beside_it(tmp_path: Path, place: str) -> None:
    message = cloud(store_of("sqlite3"), START, np.ones((20, 3)))
    bag = write_bag(tmp_path / "bag", "sqlite3", [("/points", START, message)])
    outside = tmp_path / "outside.db3"
    (bag / "bag.db3").rename(outside)
    if place.startswith("/"):
        place = str(outside)
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("bag.db3", place))
    with pytest.raises(DatasetError, match="cannot open the bag"):
        open_dataset(bag)
    outside.rename(bag / "outside.db3")  # the name alone is what counts
    assert len(list(open_dataset(bag))) == 1


def test_cubes_go_where_the_user_said_and_nowhere_else(tmp_path: Path) -> None:
    there = tmp_path / "there"
    config = MapConfig(
        cube_size=4.0, window=(3, 3, 3), window_margin=1, neighbourhood=(3, 3, 3),
        archive_megabytes=0.0, archive_dir=str(there),
    )  # fmt: skip
    cubes = CubeMap(config, 0.5)
    for metres in np.arange(0.0, 400.0, 4.0):
        cubes.recenter(np.array([-metres, metres, 0.0]))
        cubes.insert(np.array([[-metres, metres, 0.0]]))
    assert cubes.stats.archived > 50
    names = files_below(tmp_path)
    assert len(names) == cubes.stats.archived
    assert all(name.startswith("there/cubes_") for name in names)


def test_replacing_a_bag_deletes_nothing_but_a_bag(tmp_path: Path) -> None:
    diary = tmp_path / "mapped.active" / "mapped" / "diary.txt"
    diary.parent.mkdir(parents=True)
    diary.write_text("mine")
    for name in ("mapped", "mapped.mcap"):
        diary.parents[1].rename(tmp_path / f"{name}.active")
        with pytest.raises(OutputError, match="not a bag, so it is not replaced"):
            BagWriter(tmp_path / name, overwrite=True)
        (tmp_path / f"{name}.active").rename(diary.parents[1])
    assert diary.read_text() == "mine"
    diary.rename(diary.with_name("mapped_0.db3"))  # what a recording that was cut off leaves
    BagWriter(tmp_path / "mapped", overwrite=True).close()
    assert files_below(tmp_path) == set()


def test_an_error_shows_no_more_of_a_file_than_a_line(tmp_path: Path) -> None:
    (tmp_path / "0.bin").write_bytes(bytes(16))
    (tmp_path / "times.txt").write_text("x" * 1_000_000)
    with pytest.raises(LoamError) as caught:
        open_dataset(tmp_path)
    assert len(str(caught.value)) < 1000


def test_a_page_shows_names_and_does_not_run_them() -> None:
    from loam_gtsam.studies.report_html import TextTable, list_html, page, table_html

    evil = "<script>alert(1)</script>"
    sections = {evil: table_html(TextTable([evil], [[evil]])), "list": list_html({evil: evil})}
    assert "<script" not in page(evil, [evil], sections)


# -- damage ----------------------------------------------------------------------------------------


def test_what_is_damaged_for_hours_can_be_read_undamaged() -> None:
    """Mutants of a file that is refused anyway show nothing: one of each format."""
    script = ROOT.parent / "tests/fuzz/mutate.py"
    command = [sys.executable, str(script), "--files", "1", "--values", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
