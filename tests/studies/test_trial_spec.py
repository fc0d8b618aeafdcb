"""Specifications of parameter studies."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import pytest
from support.trials import write_spec

from loam_gtsam.config import Config, preset
from loam_gtsam.studies.trial_spec import load_spec
from loam_gtsam.studies.trials import COLUMNS
from loam_gtsam.types import ConfigError

PAGE = Path(__file__).resolve().parents[2] / "docs" / "parameter_studies.md"


def test_trials_are_sequences_times_configs_times_seeds_in_this_order(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "preset: aloam\nsolver: {iterations: 7}\nmap: {cube_size: 2.5e1}\n"
    )
    spec = load_spec(
        write_spec(
            tmp_path,
            """
            sequences:
              room: sim:room
              drive: {path: data/drive, frames: null, options: {topic: /points}}
            configs:
              mine: {base: mine.yaml, set: {map.window: [11, 11, 5]}}
              kiss: kiss-icp
            seeds: [3, 1]
            frames: 9
            metrics: [rpe_percent, ms_median]
            """,
        )
    )
    assert [(t.sequence, t.config_name, t.seed, t.frames, t.peer) for t in spec.trials] == [
        ("room", "mine", 3, 9, None),
        ("room", "mine", 1, 9, None),
        ("room", "kiss", 3, 9, "kiss-icp"),
        ("room", "kiss", 1, 9, "kiss-icp"),
        ("drive", "mine", None, None, None),
        ("drive", "kiss", None, None, "kiss-icp"),
    ]
    assert spec.metrics == ("rpe_percent", "ms_median")
    config = spec.trials[0].config
    assert (config.solver.method, config.solver.iterations) == ("aloam", 7)
    assert (config.map.window, config.map.cube_size) == ((11, 11, 5), 25.0)
    sent = pickle.loads(pickle.dumps(spec.trials[0]))  # as it is sent to a worker
    assert (sent, sent.id) == (spec.trials[0], spec.trials[0].id)
    drive = spec.trials[-1]
    assert drive.path == str(tmp_path / "data/drive")
    assert drive.dataset_options == {"topic": "/points"}
    assert spec.trials[0].dataset_options == {"seed": 3}


def test_what_a_sequence_sets_holds_for_every_solver_on_it(tmp_path):
    text = """
    sequences: {a: {path: x, set: {sensor.model: vlp16}}, b: y}
    configs: {aloam: {base: aloam}, kiss: kiss-icp}
    """
    trials = load_spec(write_spec(tmp_path, text)).trials
    default = Config().sensor.model
    assert [t.config.sensor.model for t in trials] == ["vlp16", "vlp16", default, default]
    assert trials[0].config.solver == preset("aloam").solver


def test_a_solver_is_swapped_into_its_base_and_nothing_else_changes(tmp_path):
    text = """
    sequences: {a: x}
    configs:
      default: gtsam
      loam: loam
      swapped: {base: loam, solver: gtsam}
      own: {solver: 'my.module:make', features: 'my.module:front_end'}
    """
    default, loam, swapped, own = load_spec(write_spec(tmp_path, text)).trials
    assert default.config == own.config == Config()
    assert loam.config == Config().changed("solver.method=loam")
    assert swapped.config == preset("loam").changed({"solver.method": "gtsam"})
    assert own.parts == {"solver": "my.module:make", "features": "my.module:front_end"}
    assert len({trial.config_hash for trial in (default, loam, swapped, own)}) == 4


def test_without_seeds_a_world_has_its_own(tmp_path):
    text = "sequences: {a: 'sim:room', b: 'sim:room?seed=4', c: folder}\nconfigs: {c: gtsam}"
    assert [t.seed for t in load_spec(write_spec(tmp_path, text)).trials] == [0, 4, None]


ROOM = "sequences: {a: sim:room}\n"
GTSAM = "configs: {c: gtsam}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a mapping"),
        ("a: {", "not valid YAML"),
        ("a: !!python/name:os.system x", "not valid YAML"),
        (ROOM, "configs: expected at least one"),
        (GTSAM, "sequences: expected at least one"),
        (ROOM + GTSAM + "sede: [1]", "unknown key 'sede'; did you mean 'seeds'? (known: "),
        (ROOM + "configs: {c: gtsm}", "configs.c.solver: unknown solver 'gtsm'"),
        (ROOM + "configs: {c: {peer: kis-icp}}", "configs.c.peer: unknown peer 'kis-icp'"),
        (ROOM + "configs: {c: {base: lom}}", "configs.c.base: unknown preset 'lom'"),
        (ROOM + "configs: {c: absent.yaml}", "absent.yaml: cannot read"),
        (ROOM + "configs: {c: {preset: loam}}", "configs.c: unknown key 'preset'"),
        (ROOM + "configs: {c: {set: {solver.iteratons: 3}}}", "did you mean 'iterations'"),
        (ROOM + "configs: {c: {set: {solver: 3}}}", "configs.c.set: expected SECTION.KEY"),
        (ROOM + "configs: {c: {set: 3}}", "configs.c.set: expected a mapping"),
        (ROOM + "configs: {c: {peer: kiss-icp, set: {solver.iterations: 3}}}", "is a peer"),
        (ROOM + "configs: {c: {solver: 3}}", "configs.c.solver: expected a name"),
        (ROOM + "configs: {1: gtsam}", "expected names as keys, got 1"),
        (GTSAM + "sequences: {a: {frames: 3}}", "sequences.a: expected a path"),
        (GTSAM + "sequences: {a: {path: x, frames: 0}}", "sequences.a.frames: expected"),
        (
            GTSAM + "sequences: {a: {path: x, set: {map.windw: 0}}}",
            "sequences.a.set: map.windw: unknown key",
        ),
        (GTSAM + "sequences: {a: 'sim:room?seed=x'}", "sequences.a: seed: expected an integer"),
        (ROOM + GTSAM + "seeds: 3", "seeds: expected a list"),
        (ROOM + GTSAM + "seeds: [1, 1]", "seeds: expected a list of different"),
        (ROOM + GTSAM + "seeds: [-1]", "seeds: expected a list"),
        (GTSAM + "sequences: {a: x}\nseeds: [1]", "only built-in worlds"),
        (GTSAM + "sequences: {a: 'sim:room?seed=2'}\nseeds: [1]", "a seed of its own"),
        (ROOM + GTSAM + "metrics: [ate]", "metrics: expected a list of ate_m"),
        (ROOM + GTSAM + "frames: many", "frames: expected a number"),
    ],
)
def test_a_wrong_specification_is_told_by_key(tmp_path, text, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        load_spec(write_spec(tmp_path, text))


def test_the_page_explains_every_column_and_its_example_can_be_read(tmp_path):
    text = PAGE.read_text("utf-8")
    assert [name for name in COLUMNS if f"`{name}`" not in text] == []
    spec = re.search(r"^```yaml\n(.*?)^```", text, re.M | re.S)
    (tmp_path / "robot.yaml").write_text("preset: loam\n")
    assert len(load_spec(write_spec(tmp_path, spec[1])).trials) > 10
