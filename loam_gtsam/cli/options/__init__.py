"""Options of the commands, each declared once: a command takes one dataclass of options."""

from loam_gtsam.cli.options.commands import CleanOptions as CleanOptions
from loam_gtsam.cli.options.commands import CompareOptions as CompareOptions
from loam_gtsam.cli.options.commands import ConfigOptions as ConfigOptions
from loam_gtsam.cli.options.commands import ConvertOptions as ConvertOptions
from loam_gtsam.cli.options.commands import DemoOptions as DemoOptions
from loam_gtsam.cli.options.commands import LocaliseOptions as LocaliseOptions
from loam_gtsam.cli.options.commands import MergeOptions as MergeOptions
from loam_gtsam.cli.options.commands import OptimizeOptions as OptimizeOptions
from loam_gtsam.cli.options.commands import RefineOptions as RefineOptions
from loam_gtsam.cli.options.commands import RunOptions as RunOptions
from loam_gtsam.cli.options.commands import StudyOptions as StudyOptions
from loam_gtsam.cli.options.common import InspectOptions as InspectOptions
from loam_gtsam.cli.options.common import Options as Options
from loam_gtsam.cli.options.common import OutputOptions as OutputOptions
from loam_gtsam.cli.options.common import PartOptions as PartOptions
from loam_gtsam.cli.options.common import SourceOptions as SourceOptions
from loam_gtsam.cli.options.common import command as command
