"""The command `saga-fg`. What a command needs is imported when it runs, so that `--help` answers at once."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipelines.cli.commands import app as app


def __getattr__(name: str) -> Any:
    """The app, imported on first use: SIGTERM is heard before."""
    if name == "app":
        from pipelines.cli.commands import app

        return app
    raise AttributeError(name)
