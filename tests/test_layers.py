"""The layering of the package, read from the imports, and what library code must not do."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1] / "loam_gtsam"
THIS = "tests/test_layers.py"

LAYERS = (
    ("freezing", "types", "config", "geometry", "rotations", "closing", "frame_view"),
    (
        "rings",
        "place",
        "sweep",
        "posts",
        "features",
        "cube_archive",
        "cubemap",
        "matching",
        "stillness",
        "gravity_filter",
        "imu",
    ),
    ("factors", "degeneracy", "imu_prior", "deskew", "inertial_factors", "inertial_window"),
    ("solvers", "classical", "inertial", "graph_optimize"),
    (
        "scan_error",
        "covariance",
        "odometry",
        "imu_aid",
        "relocalization",
        "frame_report",
        "stamps",
        "keyframes",
        "loop_consistency",
        "pose_graph",
        "loop_closure",
    ),
    ("mapper", "ahead"),
    ("loop_mapping", "checkpoint"),
    ("pipeline", "estimators", "graph_files", "live_imu", "live_report", "live_sweeps"),
    ("comparison", "recording", "watching", "evalio_pipeline", "live"),
    ("ros_topics",),
    ("experiments", "experiment_spec", "experiment_table", "experiment_workers"),
    (
        "ros",
        "ros1",
        "_cli_report",
        "_report_html",
        "_compare_files",
        "_cli_run",
        "_cli_compare",
        "_cli_optimize",
        "_cli_sweep",
        "cli",
    ),
)
"""From the bottom up; a module imports from lower layers, or as SAME_LAYER says."""

SAME_LAYER = {
    "types": {"freezing"},
    "closing": {"types"},
    "config": {"types"},
    "geometry": {"types"},
    "rotations": {"types"},
    "frame_view": {"types"},
    "sweep": {"rings"},
    "features": {"sweep", "posts"},
    "cubemap": {"cube_archive"},
    "matching": {"cubemap"},
    "gravity_filter": {"stillness"},
    "imu": {"stillness", "gravity_filter"},
    "degeneracy": {"factors"},
    "imu_prior": {"factors"},
    "inertial_window": {"inertial_factors"},
    "classical": {"solvers"},
    "covariance": {"scan_error"},
    "frame_report": {"odometry"},
    "keyframes": {"covariance"},
    "loop_consistency": {"keyframes"},
    "pose_graph": {"keyframes", "loop_consistency"},
    "loop_closure": {"keyframes", "pose_graph", "relocalization", "scan_error"},
    "watching": {"recording"},
    "experiment_spec": {"experiments"},
    "experiment_table": {"experiments", "experiment_spec"},
    "experiment_workers": {"experiments"},
    "_cli_run": {"_cli_report"},
    "_compare_files": {"_report_html"},
    "_cli_compare": {"_cli_report", "_cli_run", "_compare_files"},
    "_cli_sweep": {"_cli_run"},
    "cli": {"_cli_run", "_cli_report", "_cli_compare", "_cli_optimize", "_cli_sweep"},
}

LEAVES = {
    "datasets": {"datasets"},
    "evaluation": set(),
    "export": set(),
    "bag_messages": set(),
    "frame_messages": {"bag_messages"},
    "export_bag": {"frame_messages"},
    "peers": set(),
    "visualization": {"export"},
    "frame_plot": {"visualization"},
    "_rrd_file": set(),
    "viewer": {"_rrd_file"},
}
"""Leaves see layer 0 and these; of the layers, only the command line and LEAF_USERS see them."""

LEAF_USERS = {
    "ahead": {"datasets.base"},
    "pipeline": {"datasets.base"},
    "estimators": {"datasets.base", "peers"},
    "comparison": {"datasets.base", "evaluation", "peers"},
    "recording": {"datasets.base"},
    "watching": {"datasets.base"},
    "live": {
        "datasets.base",
        "datasets.cloud_stream",
        "datasets.imu_messages",
        "datasets.loam_messages",
    },
    "live_imu": {"datasets.tables"},
    "live_sweeps": {
        "datasets.base",
        "datasets.cloud_stream",
        "datasets.loam_messages",
        "datasets.pointcloud2",
    },
    "ros_topics": {
        "datasets.base",
        "datasets.cloud_stream",
        "datasets.loam_messages",
        "export",
        "frame_messages",
    },
    "evalio_pipeline": {"datasets.extrinsics"},
    "experiments": {"datasets", "datasets.base", "evaluation", "peers"},
    "experiment_table": {"export"},
    "graph_files": {"export"},
    "checkpoint": {"export"},
}

PRINTERS = {"cli", "_cli_run", "_cli_report", "_cli_compare", "_cli_optimize", "_cli_sweep"}
MODULES = sorted(ROOT.rglob("*.py"))
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}


def name_of(path):
    """``datasets.kitti`` for loam_gtsam/datasets/kitti.py, empty for the package itself."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def imports_of(tree):
    """Modules of the package that a syntax tree imports, as (name, line)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import; write the full name"
            module = node.module or ""
            # What ``from loam_gtsam import x`` names may be a module itself.
            names = [
                f"{module}.{alias.name}" if is_module(module, alias) else module
                for alias in node.names
            ]
        else:
            continue
        for name in names:
            if name == "loam_gtsam" or name.startswith("loam_gtsam."):
                yield name.removeprefix("loam_gtsam").removeprefix("."), node.lineno


def is_module(package, alias):
    folder = ROOT.parent.joinpath(*package.split("."))
    return (folder / f"{alias.name}.py").is_file() or (folder / alias.name).is_dir()


def fault(module, imported):
    """Why ``module`` may not import ``imported``; None if it may."""
    top, there = module.split(".")[0], imported.split(".")[0]
    for name in (top, there):
        if name and name not in LEVEL and name not in LEAVES:
            return f"{name} is in no layer: list it in LAYERS or LEAVES of {THIS}"
    if top == "":
        return None  # the package's own namespace gathers them all
    if there == "":
        return "the package's namespace is for its users; import the module itself"
    if top in LEAVES:
        allowed = LEVEL.get(there) == 0 or there in LEAVES[top]
        return (
            None if allowed else f"{top} is a leaf: it sees layer 0 and {LEAVES[top] or 'itself'}"
        )
    if there in LEAVES:
        allowed = top in LAYERS[-1] or imported in LEAF_USERS.get(top, set())
        return None if allowed else f"{there} is a leaf, which {top} does not need"
    if LEVEL[there] < LEVEL[top] or there in SAME_LAYER.get(top, set()):
        return None
    return f"{there} (layer {LEVEL[there]}) is not below {top} (layer {LEVEL[top]})"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_point_downwards(path):
    module = name_of(path)
    listed = module.split(".")[0]
    assert listed == "" or listed in LEVEL or listed in LEAVES, fault(listed, "types")
    for imported, line in imports_of(ast.parse(path.read_text(encoding="utf-8"))):
        reason = fault(module, imported)
        assert reason is None, (
            f"{path.name}:{line} imports {imported or 'loam_gtsam'}: {reason} (the rule is at "
            f"the top of {THIS})"
        )


def forbidden_in(tree):
    """What library code must not do, as (what, line)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in (
                "print",
                "breakpoint",
                "exit",
                "quit",
                "sys.exit",
                "os._exit",
                "os.abort",
            ):
                yield called, node.lineno
        elif isinstance(node, ast.Raise) and node.exc is not None:
            if ast.unparse(node.exc).startswith("SystemExit"):
                yield "SystemExit", node.lineno
        elif isinstance(node, ast.ImportFrom) and node.module in ("sys", "os"):
            for alias in node.names:
                if alias.name in ("exit", "_exit", "abort"):
                    yield f"{node.module}.{alias.name}", node.lineno


@pytest.mark.parametrize("path", [p for p in MODULES if name_of(p) not in PRINTERS], ids=name_of)
def test_library_code_neither_prints_nor_exits(path):
    found = list(forbidden_in(ast.parse(path.read_text(encoding="utf-8"))))
    assert not found, f"{path.name}: {found}; raise a LoamError, or log"


# -- that the checks above can fail ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("module", "imported", "allowed"),
    [
        ("factors", "types", True),
        ("factors", "matching", True),
        ("factors", "solvers", False),
        ("matching", "cubemap", True),
        ("cubemap", "matching", False),
        ("types", "config", False),
        ("geometry", "config", False),
        ("mapper", "pipeline", False),
        ("pipeline", "mapper", True),
        ("pipeline", "datasets.base", True),
        ("pipeline", "datasets.kitti", False),
        ("mapper", "export", False),
        ("datasets.kitti", "datasets.base", True),
        ("datasets.kitti", "geometry", True),
        ("datasets.kitti", "sweep", False),
        ("evaluation", "export", False),
        ("visualization", "export", True),
        ("export", "visualization", False),
        ("export", "mapper", False),
        ("_cli_report", "_cli_run", False),
        ("cli", "export", True),
        ("mapper", "", False),
        ("", "cli", True),
        ("brand_new", "types", False),
        ("mapper", "brand_new", False),
    ],
)
def test_the_rule_accepts_and_refuses(module, imported, allowed):
    assert (fault(module, imported) is None) is allowed


def test_an_unlisted_module_is_told_where_to_be_listed():
    assert THIS in fault("brand_new", "types")


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import loam_gtsam.solvers", ["solvers"]),
        ("from loam_gtsam.solvers import GtsamSolver", ["solvers"]),
        ("from loam_gtsam import solvers", ["solvers"]),
        ("from loam_gtsam import run, solvers", ["", "solvers"]),
        ("from loam_gtsam.datasets import kitti, bag", ["datasets.kitti", "datasets.bag"]),
        ("def f():\n    from loam_gtsam.cli import main", ["cli"]),
        ("import numpy\nfrom loam_gtsam_other import x", []),
    ],
)
def test_every_way_to_import_is_seen(code, found):
    assert [name for name, _ in imports_of(ast.parse(code))] == found


def test_relative_imports_are_refused():
    with pytest.raises(AssertionError, match="relative import"):
        list(imports_of(ast.parse("from .types import Scan")))


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("print('x')", 1),
        ("def f():\n    sys.exit(1)", 1),
        ("os._exit(0)", 1),
        ("breakpoint()", 1),
        ("raise SystemExit", 1),
        ("raise SystemExit(2)", 1),
        ("from sys import exit", 1),
        ("'''print()'''\nfingerprint()\nraise ValueError('sys.exit()')", 0),
    ],
)
def test_every_way_to_print_or_exit_is_seen(code, count):
    assert len(list(forbidden_in(ast.parse(code)))) == count
