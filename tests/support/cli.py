"""The command line, called within the process."""

import io

from rich.console import Console
from typer.testing import CliRunner, Result

from loam_gtsam.cli import app


def loam(*arguments: object) -> Result:
    """``loam-gtsam ARGUMENTS``: exit code and output."""
    return CliRunner().invoke(app.app, [str(argument) for argument in arguments])


def shown(text: object) -> str:
    """What a wide terminal shows of something."""
    console = Console(width=500, file=io.StringIO())
    console.print(text)
    return console.file.getvalue()
