"""Results on disk as scenes to view and as reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.datasets.results import SceneResult
from data_tools.datasets.source import DatasetSource
from data_tools.figures import FigureTable
from pipelines.config import load_config
from pipelines.report.charts import Chart, accuracy_charts, latency_chart
from pipelines.report.page import Report
from pipelines.report.run_record import RunRecord, read_run_record
from pipelines.report.scenes import ReportScene


@dataclass(frozen=True, eq=False)
class Results:
    """The scenes of a result, and the record of its run if there is one beside it.

    Edges are by the rules of the default configuration of such recordings.
    """

    name: str
    scenes: Sequence[ReportScene]
    record: RunRecord | None


def result_report(source: DatasetSource, result: Path) -> Report:
    """A report on the result of any tracker; with figures where the dataset has ground truth.

    Raises `InputError` for missing or broken files, and for a result that does not fit the dataset.
    """
    found = source.read_results(result)
    tables: Sequence[FigureTable] = ()
    charts: Sequence[Chart] = ()
    if source.has_truth:
        evaluation = source.evaluate(found)
        tables, charts = evaluation.tables(), accuracy_charts(evaluation.errors)
    return _report(shown_results(source, result, found), tables, charts)


def shown_results(source: DatasetSource, result: Path, found: Mapping[str, SceneResult]) -> Results:
    """What was read of a result, as scenes to look at. Raises `InputError` for a broken record of the run."""
    record, config = read_run_record(result), load_config(source.family)
    method = record.method if record is not None else "tracks"
    scenes = [
        ReportScene(
            each.scene,
            {method: each.found},
            {} if each.coasting is None else {method: each.coasting},
            config.tracker.edges,
            config.sensors,
        )
        for each in found.values()
    ]
    return Results(result.name, scenes, record)


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
