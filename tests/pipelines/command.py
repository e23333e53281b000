"""The command, in this process and in one of its own."""

from __future__ import annotations

import sys

from typer.testing import CliRunner, Result

from pipelines.cli import app

COMMAND = [sys.executable, "-c", "from pipelines.cli.main import main; main()"]


def saga_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def done(*arguments: object) -> Result:
    """A command that succeeds."""
    result = saga_fg(*arguments)
    assert result.exit_code == 0, result.output
    return result


def refused(*arguments: object) -> str:
    """What a command says on stderr that is refused."""
    result = saga_fg(*arguments)
    assert result.exit_code == 2, result.output
    return result.stderr
