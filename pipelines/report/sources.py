"""Reports on results on disk: nuScenes, KITTI, and tables of tracks."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from data_tools.datasets.kitti.scored_sequences import read_scored_sequences
from data_tools.datasets.nuscenes import read_scored_scenes
from pipelines.evaluation import evaluate_kitti, evaluate_nuscenes
from pipelines.figures import FigureTable
from pipelines.report.charts import Chart, accuracy_charts, latency_chart
from pipelines.report.page import Report
from pipelines.report.results import Results, kitti_results, nuscenes_results, table_results
from pipelines.report.run_record import RunRecord


def nuscenes_report(
    result: Path, dataroot: Path, version: str, scenes: Collection[str], detections: Mapping[str, Path]
) -> Report:
    """Report on a tracking-result JSON of any tracker, in the chosen scenes.

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes.
    """
    scored = read_scored_scenes(result, dataroot, version, scenes, detections)
    evaluation = evaluate_nuscenes(scored)
    return _report(nuscenes_results(result, scored), evaluation.tables(), accuracy_charts(evaluation.errors))


def kitti_report(result: Path, dataroot: Path, sequences: Collection[str] | None, detections: Path | None) -> Report:
    """Report on a folder of results NNNN.txt of any tracker; the same errors as above."""
    scored = read_scored_sequences(result, dataroot, sequences, detections)
    evaluation = evaluate_kitti(scored)
    return _report(kitti_results(result, scored), evaluation.tables(), accuracy_charts(evaluation.errors))


def table_report(result: Path, detections: Path | None) -> Report:
    """Report on a table of tracks; without ground truth there are no figures. Raises `InputError` for broken tables."""
    return _report(table_results(result, detections), (), ())


def _report(results: Results, tables: Sequence[FigureTable], charts: Sequence[Chart]) -> Report:
    record = results.record
    moments = sum(len(each.scene) for each in results.scenes)
    boxes = sum(len(table) for each in results.scenes for table in each.tracks.values())
    facts = [f"{len(results.scenes)} scenes, {moments} moments", f"{boxes} boxes"]
    if record is None:
        return Report(results.name, facts, results.scenes, tables, charts)
    facts += [f"method {record.method}", f"saga-fg {record.version}"]
    return Report(results.name, facts, results.scenes, tables, [*charts, *_latency(record)], record.configuration)


def _latency(record: RunRecord) -> list[Chart]:
    times = [ms for scene in record.milliseconds.values() for ms in scene]
    return [latency_chart(np.array(times))] if times else []
