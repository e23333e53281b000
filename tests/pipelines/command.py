"""The command, in this process and in one of its own."""

from __future__ import annotations

import sys

from typer.testing import CliRunner, Result

from pipelines.cli import app

COMMAND = [sys.executable, "-c", "from pipelines.cli.main import main; main()"]


def saga_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])
