"""One comparison from the command line: run, tables, files, pictures, report."""

from __future__ import annotations

import csv
import io
import json
import math
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from loam_gtsam import visualization
from loam_gtsam._cli_run import (
    TRUTH_FILE,
    RunOptions,
    dataset_file_name,
    frame_progress,
    free_folder,
    stop_requests,
)
from loam_gtsam._report_html import write_report
from loam_gtsam.comparison import (
    Comparison,
    Contender,
    FrameDifferences,
    Scores,
    SolverRun,
    compare,
    frame_differences,
    score,
)
from loam_gtsam.config import Config, config_to_dict
from loam_gtsam.datasets.base import Dataset
from loam_gtsam.evaluation import absolute_error, align, distance_travelled, interpolate
from loam_gtsam.export import make_folder, replacing, stage_seconds, write_tum
from loam_gtsam.types import DatasetError, FloatArray, InputError, OutputError, Trajectory

TABLE_FILES = ("comparison.csv", "comparison.json", "frames.csv")
PICTURES = {
    "trajectories.png": "Trajectories",
    "errors.png": "Position error over the distance travelled",
    "differences.png": "Differences from the first-named solver, frame by frame",
    "stages.png": "Time per stage",
}
REPORT_FILE = "report.html"
