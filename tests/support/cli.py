"""The command line, called within the process."""

from typer.testing import CliRunner, Result

from loam_gtsam.cli import app


def loam(*arguments: object) -> Result:
    """``loam-gtsam ARGUMENTS``: exit code and output."""
    return CliRunner().invoke(app.app, [str(argument) for argument in arguments])
