"""Results read back: the tracks that a file or folder holds for the scenes of a dataset."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files import TrackRows, read_tracks
from data_tools.files.error_messages import unknown_name
from data_tools.metrics import SceneBoxes
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.dataset import Dataset, Scene
from saga_fg.types.track import known_velocities

log = logging.getLogger(__name__)

_SAME_TIME = 1e-4  # s


@dataclass(frozen=True, eq=False)
class SceneResult:
    """A scene, with detections and ground truth where there are some, and the tracks found in it, world coordinates.

    coasting  (N,) s since the last detection, NaN where unknown; None if nothing is known of it
    """

    scene: Scene
    found: SceneBoxes
    coasting: FloatArray | None = field(default=None, kw_only=True)


def read_table_results(path: Path, dataset: Dataset | None, every_scene: bool = False) -> dict[str, SceneResult]:
    """A table of tracks in those scenes of a dataset that it has; rows of other scenes are left out.

    every_scene  include scenes without a row, in which nothing was found; an empty table always has all scenes

    Without a dataset, the scenes are those of the table: their moments are the times of its rows, and the vehicle
    stands amid all tracks. Logs a warning where scenes are left out. Raises `InputError` for a broken table, for one
    that has none of the scenes, and for times that are no moments of their scene.
    """
    rows = read_tracks(path)
    there = tuple(dict.fromkeys(rows.scene.tolist()))
    if dataset is None:
        return {name: scene_result(_scene(rows, name), rows, path) for name in there}
    if there and not set(there) & set(dataset.scenes):
        raise InputError(f"{path}: {unknown_name('scene', there[0], dataset.scenes)}")
    chosen = [name for name in dataset.scenes if every_scene or not there or name in there]
    if len(chosen) < len(dataset.scenes):
        log.warning(
            "%s: has tracks in %d of the %d scenes of the dataset, the others are left out",
            path,
            len(chosen),
            len(dataset.scenes),
        )
    return {name: scene_result(dataset.scene(name), rows, path) for name in chosen}


def _scene(rows: TrackRows, name: str) -> Scene:
    mine = rows.scene == name
    times = np.unique(rows.timestamp[mine])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :2, 3] = np.median(rows.boxes.position[mine, :2], axis=0)
    return Scene(name, times, poses, ("",) * len(times), ())


def scene_result(scene: Scene, rows: TrackRows, path: str | Path) -> SceneResult:
    """The rows of a scene at its moments. Raises `InputError` for times that are none; `path` is named."""
    mine: IntArray = np.flatnonzero(rows.scene == scene.name)
    moment = np.searchsorted(scene.timestamps, rows.timestamp[mine] - _SAME_TIME)
    at = np.minimum(moment, len(scene) - 1)
    strange = np.abs(scene.timestamps[at] - rows.timestamp[mine]) > _SAME_TIME
    if strange.any():
        time = rows.timestamp[mine][np.argmax(strange)]
        raise InputError(
            f"{path}: scene {scene.name}: expected the times of the detections, they have none at {time} s"
        )
    order = np.argsort(moment, kind="stable")
    chosen = mine[order]
    boxes = rows.boxes.select(chosen)
    boxes = replace(boxes, velocity=known_velocities(boxes.velocity, rows.velocity_covariance[chosen]))
    found = SceneBoxes(moment[order], rows.id[chosen], boxes, rows.score[chosen], rows.position_covariance[chosen])
    return SceneResult(scene, found, coasting=rows.coasting[chosen])
