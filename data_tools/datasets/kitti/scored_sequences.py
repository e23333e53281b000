"""Tracking results in KITTI's text format beside the labels: as the benchmark scores them, and in world coordinates.

Velocities and covariances come from the table `tracks.csv` beside the results, if there is one; else they are unknown.
So is a velocity of a large standard deviation there (`saga_fg.types.track.known_velocities`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files import TrackRows, read_tracks
from data_tools.datasets.kitti.dataset import FRAME_PERIOD, KittiTracking
from data_tools.datasets.kitti.labels import lower_case_classes, read_kitti_labels
from data_tools.datasets.kitti.tracking_results import TRACK_TABLE
from data_tools.datasets.results import SceneResult
from data_tools.files.error_messages import error_context
from data_tools.kitti_objects import KittiObjects, camera_boxes_to_world, has_box
from data_tools.metrics.scene_boxes import SceneBoxes
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform
from saga_fg.types.track import known_velocities


@dataclass(frozen=True, eq=False)
class ScoredSequence(SceneResult):
    """One sequence: also the lines of its label file and of the result, and the true boxes in world coordinates."""

    labels: KittiObjects
    result: KittiObjects
    truth: SceneBoxes


def read_scored_sequences(
    result: str | Path,
    dataroot: str | Path,
    sequences: Collection[str] | None = None,
    detections: str | Path | None = None,
) -> dict[str, ScoredSequence]:
    """The chosen sequences by name (None: all that folder `result` has a file for).

    Raises `InputError` for missing or broken files, and for results beyond the end of a sequence.
    """
    chosen = result_sequences(result) if sequences is None else sequences
    return scored_sequences(result, KittiTracking(dataroot, detections, chosen, ground_truth=True))


def result_sequences(result: str | Path) -> tuple[str, ...]:
    """The sequences that a folder has results for. Raises `InputError` where there are none."""
    found = tuple(sorted(path.stem for path in Path(result).glob("[0-9]*.txt")))
    if not found:
        raise InputError(f"{result}: expected results NNNN.txt, there are none")
    return found


def scored_sequences(result: str | Path, dataset: KittiTracking) -> dict[str, ScoredSequence]:
    """The sequences of a dataset with ground truth, each with its result; raises as `read_scored_sequences` does."""
    folder = Path(result)
    table = read_tracks(folder / TRACK_TABLE) if (folder / TRACK_TABLE).exists() else None
    return {name: _scored(folder / f"{name}.txt", name, dataset, table) for name in dataset.scenes}


def _scored(path: Path, name: str, dataset: KittiTracking, table: TrackRows | None) -> ScoredSequence:
    if not path.is_file():
        raise InputError(f"{path}: expected the results of sequence {name}, there is no such file")
    scene = dataset.scene(name)
    result = read_kitti_labels(path)
    if len(result) and result.frame.max() >= len(scene):
        raise InputError(f"{path}: frame {result.frame.max()}: expected frames 0 to {len(scene) - 1} only")
    world_T_camera = scene.world_T_ego @ inverse_transform(dataset.calibration(name).camera_T_imu)
    with error_context(str(path)):
        found = _in_world(result, world_T_camera)
    if table is not None:
        found = _with_motion(found, table, name)
    assert scene.ground_truth is not None
    truth = SceneBoxes.of_annotations(scene.ground_truth)
    return ScoredSequence(scene, found, dataset.labels(name), result, truth)


def _in_world(objects: KittiObjects, world_T_camera: FloatArray) -> SceneBoxes:
    """Objects with a 3D box; `world_T_camera` (K, 4, 4) of the frames."""
    objects = objects.select(has_box(objects) & (objects.track_id >= 0))
    objects = objects.select(np.argsort(objects.frame, kind="stable"))
    boxes = camera_boxes_to_world(objects.boxes, lower_case_classes(objects.type), world_T_camera[objects.frame])
    return SceneBoxes(objects.frame, objects.track_id.astype(np.str_), boxes, np.nan_to_num(objects.score))


def _with_motion(found: SceneBoxes, table: TrackRows, scene: str) -> SceneBoxes:
    """The boxes with velocities and covariances of the rows of the same frame and track."""
    rows = np.flatnonzero(table.scene == scene)
    frame = np.rint(table.timestamp[rows] / FRAME_PERIOD).astype(np.int64)
    row_of = dict(zip(zip(frame.tolist(), table.id[rows].tolist(), strict=True), rows.tolist(), strict=True))
    wanted = zip(found.frame.tolist(), found.id.tolist(), strict=True)
    at = np.array([row_of.get(key, -1) for key in wanted], dtype=np.int64)
    known = at >= 0
    velocity, covariance = found.boxes.velocity.copy(), found.position_covariance.copy()
    velocity[known] = known_velocities(table.boxes.velocity[at[known]], table.velocity_covariance[at[known]])
    covariance[known] = table.position_covariance[at[known]]
    return replace(found, boxes=replace(found.boxes, velocity=velocity), position_covariance=covariance)
