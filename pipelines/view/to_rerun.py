"""Drawings for rerun (https://rerun.io): a file .rrd, written whole or not at all, or a viewer on the screen.

Paths are rerun's entities, frames its transforms; times are on the timelines `time`, s, and `moment`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, assert_never

import numpy as np

from data_tools.files.atomic_files import atomic_file
from pipelines.view.drawing import Arrows, Drawing, Lines, Points, Pose, Shape, Solids
from saga_fg.errors import InputError, MissingExtraError
from saga_fg.numerics.geometry import yaw_quaternion

APPLICATION = "saga-fg"


def load_rerun() -> ModuleType:
    """The package rerun. Raises `MissingExtraError` where it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError('the 3D view needs rerun; pip install "saga-fg[view]"') from error
    module: ModuleType = rerun
    return module


def write_rerun(path: Path, name: str, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    """Write a file that rerun opens.

    name   of the recording, for the viewer's list
    roots  frames that get a 3D view each

    Raises `InputError` where the file cannot be written, `MissingExtraError` without rerun.
    """
    rerun = load_rerun()
    with atomic_file(path) as file:
        stream = rerun.RecordingStream(APPLICATION, recording_id=name)
        stream.save(file.name, default_blueprint=_blueprint(roots))
        try:
            _log(stream, roots, drawings)
            _flushed(stream, path)
        finally:
            stream.disconnect()


def _flushed(stream: Any, path: Path) -> None:
    try:
        stream.flush()
    except RuntimeError as error:  # rerun writes in a thread of its own, and says no more than that it failed
        raise InputError(f"{path}: not written, is the disk full? {error}") from error


def show_rerun(name: str, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    """Open rerun's viewer on the screen and draw there; it stays open. Otherwise as `write_rerun`."""
    rerun = load_rerun()
    stream = rerun.RecordingStream(APPLICATION, recording_id=name)
    stream.spawn(default_blueprint=_blueprint(roots))
    _log(stream, roots, drawings)
    stream.flush()


def _blueprint(roots: Sequence[str]) -> Any:
    """Return a layout with a tab for each root."""
    from rerun import blueprint

    views = [blueprint.Spatial3DView(origin=f"/{root}", name=root) for root in roots]
    return blueprint.Blueprint(blueprint.Tabs(*views), collapse_panels=True)


def _log(stream: Any, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    rerun = load_rerun()
    for root in roots:
        stream.log(root, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for each in drawings:
        if each.time is not None:
            stream.reset_time()
            stream.set_time("time", duration=each.time)
        if each.moment is not None:
            stream.set_time("moment", sequence=each.moment)
        stream.log(each.path, _archetype(each.shape), static=each.time is None)


def _archetype(shape: Shape) -> Any:
    rerun = load_rerun()
    match shape:
        case Solids():
            solids = rerun.Ellipsoids3D if shape.round else rerun.Boxes3D
            return solids(
                centers=shape.centre,
                half_sizes=shape.size / 2,
                quaternions=np.roll(yaw_quaternion(shape.yaw), -1, axis=1),  # x y z w
                colors=_colours(shape),
                labels=shape.labels or None,
                show_labels=False,
            )
        case Lines():
            return rerun.LineStrips3D(shape.strips, colors=_colours(shape), radii=shape.radius)
        case Arrows():
            vector = np.column_stack([shape.vector, np.zeros(len(shape.vector))])
            return rerun.Arrows3D(vectors=vector, origins=shape.tail, colors=_colours(shape), radii=[shape.radius])
        case Points():
            return rerun.Points3D(shape.points, radii=[shape.radius], colors=_colours(shape), labels=shape.names)
        case Pose():
            pose = shape.parent_T_child
            return rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
    assert_never(shape)


def _colours(shape: Solids | Lines | Arrows | Points) -> Any:
    return shape.colour.astype(np.uint8)
