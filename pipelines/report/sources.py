"""Reports on results as they are on disk: nuScenes, KITTI, and tables of one's own."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from data_tools.detection_files import TrackRows, read_detections, read_tracks
from data_tools.kitti.scored_sequences import read_scored_sequences
from data_tools.metrics import TrackTable
from data_tools.nuscenes import NuScenes, read_scored_scenes
from pipelines.config import Family, load_config
from pipelines.evaluation import evaluate_kitti, evaluate_nuscenes
from pipelines.figures import FigureTable
from pipelines.report.charts import Chart, accuracy_charts, latency_chart
from pipelines.report.page import Report
from pipelines.report.run_record import RunRecord, read_run_record
from pipelines.report.scenes import ReportScene
from saga_fg.arrays import FloatArray, IntArray
from saga_fg.dataset import Scene
from saga_fg.errors import InputError


def nuscenes_report(
    result: Path, dataroot: Path, version: str, scenes: Collection[str], detections: Mapping[str, Path]
) -> Report:
    """On a tracking-result JSON of any tracker, in the chosen scenes.

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes.
    """
    scored = read_scored_scenes(result, dataroot, version, scenes)
    dataset = NuScenes(dataroot, version, detections, tuple(scored), ground_truth=True)
    evaluation = evaluate_nuscenes(result, dataroot, version, scenes, detections)
    shown = [(dataset.scene(name), each.found, None) for name, each in scored.items()]
    return _report(result, "nuscenes", shown, evaluation.tables(), accuracy_charts(evaluation.errors))


def kitti_report(result: Path, dataroot: Path, sequences: Collection[str] | None, detections: Path | None) -> Report:
    """On a folder of results NNNN.txt of any tracker; the same errors as above."""
    scored = read_scored_sequences(result, dataroot, sequences, detections)
    evaluation = evaluate_kitti(result, dataroot, sequences, detections=detections)
    shown = [(each.scene, each.found, None) for each in scored.values()]
    return _report(result, "kitti", shown, evaluation.tables(), accuracy_charts(evaluation.errors))


def table_report(result: Path, detections: Path | None) -> Report:
    """On a table of tracks; without ground truth there are no figures. Raises `InputError` for broken tables."""
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
    return _report(result, "file", shown, (), ())


def _amid(rows: TrackRows, mine: IntArray, count: int) -> FloatArray:
    """Where nobody says where the vehicle is: poses (count, 4, 4) in the middle of all tracks."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :2, 3] = np.median(rows.boxes.position[mine, :2], axis=0)
    return poses


def _placed(scene: Scene, rows: TrackRows, mine: IntArray, path: Path) -> tuple[Scene, TrackTable, FloatArray]:
    moment = np.searchsorted(scene.timestamps, rows.timestamp[mine] - 1e-6)
    strange = (moment >= len(scene)) | (np.abs(scene.timestamps[moment % len(scene)] - rows.timestamp[mine]) > 1e-6)
    if strange.any():
        time = rows.timestamp[mine][np.argmax(strange)]
        raise InputError(
            f"{path}: scene {scene.name}: expected the times of the detections, they have none at {time} s"
        )
    order = np.argsort(moment, kind="stable")
    chosen = mine[order]
    table = TrackTable(
        moment[order], rows.id[chosen], rows.boxes.select(chosen), rows.score[chosen], rows.position_covariance[chosen]
    )
    return scene, table, rows.coasting[chosen]


def _report(
    result: Path,
    family: Family,
    shown: Sequence[tuple[Scene, TrackTable, FloatArray | None]],
    tables: Sequence[FigureTable],
    charts: Sequence[Chart],
) -> Report:
    record, config = read_run_record(result), load_config(family)
    method = record.method if record is not None else "tracks"
    scenes = [
        ReportScene(
            scene, {method: table}, {} if coasting is None else {method: coasting}, config.tracker.edges, config.sensors
        )
        for scene, table, coasting in shown
    ]
    moments, boxes = sum(len(scene) for scene, _, _ in shown), sum(len(table) for _, table, _ in shown)
    facts = [f"{len(shown)} scenes, {moments} moments", f"{boxes} boxes"]
    if record is None:
        return Report(result.name, facts, scenes, tables, charts)
    facts += [f"method {record.method}", f"saga-fg {record.version}"]
    return Report(result.name, facts, scenes, tables, [*charts, *_latency(record)], record.configuration)


def _latency(record: RunRecord) -> list[Chart]:
    times = [ms for scene in record.milliseconds.values() for ms in scene]
    return [latency_chart(np.array(times))] if times else []
