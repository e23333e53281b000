"""Where a view goes: a file .rrd, whole or not at all, or a viewer on the screen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from data_tools.atomic_files import atomic_file
from saga_fg.errors import InputError, MissingExtraError

APPLICATION = "saga-fg"
Draw = Callable[[Any], None]
"""Logs something to a stream of rerun, `rerun.RecordingStream`."""


def load_rerun() -> ModuleType:
    """The package rerun. Raises `MissingExtraError` where it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError('the view in space needs rerun; pip install "saga-fg[view]"') from error
    module: ModuleType = rerun
    return module


def write_view(path: Path, name: str, roots: Sequence[str], draw: Draw) -> None:
    """Write what `draw` logs to a file that rerun opens.

    name   of the recording, for the viewer's list
    roots  entities that get a view in space each

    Raises `InputError` where the file cannot be written, `MissingExtraError` without rerun.
    """
    rerun = load_rerun()
    with atomic_file(path) as file:
        stream = rerun.RecordingStream(APPLICATION, recording_id=name)
        stream.save(file.name, default_blueprint=_blueprint(roots))
        try:
            draw(stream)
            _flushed(stream, path)
        finally:
            stream.disconnect()


def _flushed(stream: Any, path: Path) -> None:
    try:
        stream.flush()
    except RuntimeError as error:  # rerun writes in a thread of its own, and says no more than that it failed
        raise InputError(f"{path}: not written, is the disk full? {error}") from error


def show_view(name: str, roots: Sequence[str], draw: Draw) -> None:
    """Open rerun's viewer on the screen and log to it what `draw` logs; it stays open."""
    rerun = load_rerun()
    stream = rerun.RecordingStream(APPLICATION, recording_id=name)
    stream.spawn(default_blueprint=_blueprint(roots))
    draw(stream)
    stream.flush()


def _blueprint(roots: Sequence[str]) -> Any:
    """A tab in space for each root."""
    from rerun import blueprint

    views = [blueprint.Spatial3DView(origin=f"/{root}", name=root) for root in roots]
    return blueprint.Blueprint(blueprint.Tabs(*views), collapse_panels=True)
