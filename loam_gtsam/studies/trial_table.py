"""The results of a parameter study: one small file per finished trial, and one table of all trials.

The file of a trial is written as soon as the trial ends, so that an interrupted study can go on.
The table is a Parquet file that is made of the files of the trials.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from loam_gtsam.config import config_to_dict
from loam_gtsam.io.atomic import atomic_file
from loam_gtsam.studies.trial_spec import Spec
from loam_gtsam.studies.trials import COLUMNS, Row, Trial, empty_row, versions
from loam_gtsam.types import OutputError

TABLE_FILE = "results.parquet"
TRIALS_FOLDER = "trials"
_LABELS = ("sequence", "config")
"""Columns whose values come from the specification and not from the run."""


class TrialStore:
    """The finished trials in a folder.

    Parameters
    ----------
    folder : of the results; the files of the trials are in its folder ``trials``
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / TRIALS_FOLDER

    def save(self, row: Row) -> None:
        """Write the file of a finished trial.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        with atomic_file(self._file(row["trial"])) as file:
            file.write((json.dumps(row, indent=1, allow_nan=False) + "\n").encode("utf-8"))

    def load(self, trial: Trial) -> Row | None:
        """The row of a trial if the installed versions have finished it; else None.

        The row of a file that cannot be read is None as well: the trial runs again.
        """
        try:
            row = json.loads(self._file(trial.id).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(row, dict) or set(row) != set(COLUMNS) or row["trial"] != trial.id:
            return None
        if any(row[name] != value for name, value in versions().items()):
            return None
        # The names in the specification may have changed since the trial ran.
        label = empty_row(trial)
        return row | {name: label[name] for name in _LABELS}

    def _file(self, trial: str) -> Path:
        return self.folder / f"{trial}.json"


def write_table(path: Path, rows: Iterable[Row], spec: Spec) -> None:
    """Write the table, with the specification and all configurations in its metadata.

    Raises
    ------
    OutputError
        If pyarrow is missing or the file cannot be written.
    """
    arrow, parquet = import_pyarrow()
    kinds = {str: arrow.string(), int: arrow.int64(), float: arrow.float64()}
    configs = {trial.config_hash: config_to_dict(trial.config) for trial in spec.trials}
    metadata = {"loam_gtsam.spec": spec.text, "loam_gtsam.configs": json.dumps(configs)}
    schema = arrow.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()], metadata)
    with atomic_file(path) as file:
        parquet.write_table(arrow.Table.from_pylist(list(rows), schema), file)


def read_table(path: Path) -> tuple[list[Row], Mapping[str, Any]]:
    """The rows of a table, and the full configurations by their ``config_hash``.

    Raises
    ------
    OutputError
        If pyarrow is missing.
    """
    _, parquet = import_pyarrow()
    table = parquet.read_table(path)
    rows: list[Row] = table.to_pylist()
    configs: dict[str, Any] = json.loads(table.schema.metadata[b"loam_gtsam.configs"])
    return rows, configs


def import_pyarrow() -> tuple[Any, Any]:
    """``pyarrow`` and ``pyarrow.parquet``.

    Raises
    ------
    OutputError
        If it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise OutputError(
            f'the table needs pyarrow ({error}): pip install "loam_gtsam[cluster]"'
        ) from error
    return pyarrow, pyarrow.parquet
