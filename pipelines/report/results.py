"""Results on disk as scenes to view and as reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files import read_predictions
from data_tools.datasets.results import SceneResult
from data_tools.datasets.source import DatasetSource
from data_tools.figures import FigureTable
from pipelines.config import load_config
from pipelines.report.charts import Chart, accuracy_charts, latency_chart
from pipelines.report.page import Report
from pipelines.report.run_record import read_run_record
from pipelines.report.scenes import ReportScene


def result_report(source: DatasetSource, result: Path) -> Report:
    """Report on the result of any tracker; with figures where the dataset has ground truth.

    Raises `InputError` for missing or broken files, and for a result that does not fit the dataset.
    """
    found, record = source.read_results(result), read_run_record(result)
    scenes = result_scenes(source, result, found)
    tables: Sequence[FigureTable] = ()
    charts: list[Chart] = []
    if source.has_truth:
        evaluation = source.evaluate(found)
        tables, charts = evaluation.tables(), accuracy_charts(evaluation.errors)
    moments, boxes = sum(len(each.scene) for each in scenes), sum(len(each.found) for each in found.values())
    facts = [f"{len(scenes)} scenes, {moments} moments", f"{boxes} boxes"]
    if record is not None:
        facts += [f"method {record.method}", f"saga-fg {record.version}"]
        times = [ms for scene in record.milliseconds.values() for ms in scene]
        charts += [latency_chart(np.array(times))] if times else []
    return Report(result.name, facts, scenes, tables, charts, record.configuration if record is not None else "")


def result_scenes(source: DatasetSource, result: Path, found: Mapping[str, SceneResult]) -> list[ReportScene]:
    """Return the scenes of a result, with edges by the rules of the dataset's default configuration.

    Raises `InputError` for a broken record of the run, or broken predictions.
    """
    record, config = read_run_record(result), load_config(source.family)
    method = record.method if record is not None else "tracks"
    predicted = read_predictions(result)
    return [
        ReportScene(
            each.scene,
            {method: each.found},
            {} if each.coasting is None else {method: each.coasting},
            config.tracker.edges,
            config.sensors,
            {method: predicted[name]} if name in predicted else {},
        )
        for name, each in found.items()
    ]
