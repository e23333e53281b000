"""The command `saga-fg`. Pipelines are imported when a command runs, so that `--help` answers at once."""

from pipelines.cli.main import app, main

__all__ = ["app", "main"]
