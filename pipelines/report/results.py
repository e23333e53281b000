"""Results on disk as scenes to view: nuScenes, KITTI, and tables of tracks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files import TrackRows, read_detections, read_tracks
from data_tools.datasets.kitti.scored_sequences import ScoredSequence
from data_tools.datasets.nuscenes import ScoredScene
from data_tools.metrics import SceneBoxes
from pipelines.config import Family, load_config
from pipelines.report.run_record import RunRecord, read_run_record
from pipelines.report.scenes import ReportScene
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.types.dataset import Scene


@dataclass(frozen=True, eq=False)
class Results:
    """The scenes of a result, and the record of its run if there is one beside it.

    Edges are by the rules of the default configuration of such recordings.
    """

    name: str
    scenes: Sequence[ReportScene]
    record: RunRecord | None


def nuscenes_results(result: Path, scored: Mapping[str, ScoredScene]) -> Results:
    """Read a tracking-result JSON, of any tracker. Raises `InputError` for a broken record of the run."""
    return _results(result, "nuscenes", ((each.scene, each.tracking.found, None) for each in scored.values()))


def kitti_results(result: Path, scored: Mapping[str, ScoredSequence]) -> Results:
    """Read a folder of results NNNN.txt. Raises `InputError` as above."""
    return _results(result, "kitti", ((each.scene, each.found, None) for each in scored.values()))


def table_results(result: Path, detections: Path | None) -> Results:
    """Read a table of tracks, with the table of their detections. Raises `InputError` for broken tables."""
    rows = read_tracks(result)
    dataset = read_detections(detections) if detections is not None else None
    shown = []
    for name in dict.fromkeys(rows.scene.tolist()):
        mine = np.flatnonzero(rows.scene == name)
        if dataset is None:
            times = np.unique(rows.timestamp[mine])
            scene = Scene(name, times, _amid(rows, mine, len(times)), ("",) * len(times), ())
        else:
            scene = dataset.scene(name)
        shown.append(_placed(scene, rows, mine, result))
    return _results(result, "file", shown)


def _results(result: Path, family: Family, shown: Iterable[tuple[Scene, SceneBoxes, FloatArray | None]]) -> Results:
    record, config = read_run_record(result), load_config(family)
    method = record.method if record is not None else "tracks"
    scenes = [
        ReportScene(
            scene, {method: table}, {} if coasting is None else {method: coasting}, config.tracker.edges, config.sensors
        )
        for scene, table, coasting in shown
    ]
    return Results(result.name, scenes, record)


def _amid(rows: TrackRows, mine: IntArray, count: int) -> FloatArray:
    """Return poses (count, 4, 4) in the middle of all tracks, in place of unknown poses of the vehicle."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :2, 3] = np.median(rows.boxes.position[mine, :2], axis=0)
    return poses


def _placed(scene: Scene, rows: TrackRows, mine: IntArray, path: Path) -> tuple[Scene, SceneBoxes, FloatArray]:
    moment = np.searchsorted(scene.timestamps, rows.timestamp[mine] - 1e-6)
    strange = (moment >= len(scene)) | (np.abs(scene.timestamps[moment % len(scene)] - rows.timestamp[mine]) > 1e-6)
    if strange.any():
        time = rows.timestamp[mine][np.argmax(strange)]
        raise InputError(
            f"{path}: scene {scene.name}: expected the times of the detections, they have none at {time} s"
        )
    order = np.argsort(moment, kind="stable")
    chosen = mine[order]
    table = SceneBoxes(
        moment[order], rows.id[chosen], rows.boxes.select(chosen), rows.score[chosen], rows.position_covariance[chosen]
    )
    return scene, table, rows.coasting[chosen]
