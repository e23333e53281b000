"""The command `saga-fg`. Pipelines are imported when a command runs, so that `--help` answers at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipelines.cli.main import main

if TYPE_CHECKING:
    from pipelines.cli.commands import app

__all__ = ["app", "main"]


def __getattr__(name: str) -> Any:
    """The app, imported on first use: `main` is to be at hand at once."""
    if name == "app":
        from pipelines.cli.commands import app

        return app
    raise AttributeError(name)
