"""Coverage-guided fuzzing of the YAML configuration.

python tests/fuzz/fuzz_config.py -max_total_time=300 -max_len=2048 corpus_config
python tests/fuzz/fuzz_config.py --show findings/0123456789ab
"""

from __future__ import annotations

import atheris

with atheris.instrument_imports(include=["loam_gtsam", "ruamel.yaml"]):
    from harness import fuzz

    from loam_gtsam.config import dump_config, parse_config
    from loam_gtsam.types import ConfigError


def load(data: bytes) -> None:
    """A configuration that is accepted must survive being written and read."""
    try:
        config = parse_config(data.decode("utf-8", errors="replace"))
    except ConfigError as error:
        if len(str(error)) > 10_000:
            raise AssertionError("a message that nobody reads") from error
        return
    try:
        again = parse_config(dump_config(config))
    except ConfigError as error:
        raise AssertionError("what was written cannot be read") from error
    assert again == config


if __name__ == "__main__":
    fuzz(load)
