"""Results on disk as scenes to view and as reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files import read_predictions
from data_tools.datasets.results import SceneResult
from data_tools.datasets.source import DatasetSource
from data_tools.figures import FigureTable
from pipelines.config import load_config
from pipelines.report.charts import Chart, accuracy_charts, latency_chart
from pipelines.report.images import thumbnails
from pipelines.report.page import Report
from pipelines.report.run_record import RunRecord, read_run_record
from pipelines.report.scenes import ReportScene
from pipelines.report.track_figures import track_charts, track_figures
from pipelines.sensor_clocks import clock_table
from saga_fg.errors import InputError


@dataclass(frozen=True, eq=False)
class _Result:
    """A result that has been read: of a method, by scene, with the record of its run where there is one."""

    method: str
    path: Path
    found: Mapping[str, SceneResult]
    record: RunRecord | None


def result_report(source: DatasetSource, result: Path, beside: Path | None = None, images: int = 0) -> Report:
    """Report on the result of any tracker; with figures where the dataset has ground truth, else of the tracks alone.

    beside  another result of the same recordings, to show beside it
    images  width of the camera images to show, pixels; 0: none

    Raises `InputError` for missing or broken files, and for a result that does not fit the dataset or the other one.
    """
    results = [_read(source, result)]
    if beside is not None:
        results = _with_distinct_names(results[0], _read(source, beside))
    scenes = _scenes(source, results[0])
    for other in results[1:]:
        scenes = [_joined(scene, other, added) for scene, added in _pairs(scenes, _scenes(source, other))]
    scenes = _on_the_ground(source, scenes, images)
    tables: list[FigureTable] = []
    charts: list[Chart] = []
    for each in results:
        found = {scene.scene.name: each.found[scene.scene.name] for scene in scenes if scene.scene.name in each.found}
        prefix = f"{each.method}: " if len(results) > 1 else ""
        own_tables, own_charts = _figures(source, found)
        if each.record is not None:
            times = [ms for of_scene in each.record.milliseconds.values() for ms in of_scene]
            own_charts += [latency_chart(np.array(times))] if times else []
            own_tables += [clock_table(each.record.clocks)] if each.record.clocks else []
        tables += [replace(table, title=prefix + table.title) for table in own_tables]
        charts += [replace(chart, title=prefix + chart.title) for chart in own_charts]
    first = results[0]
    names = [each.scene.name for each in scenes]
    facts = [", ".join(each.path.name for each in results)]
    facts += [f"{len(names)} scenes" if len(names) > 3 else ", ".join(names)]
    facts += [f"{sum(len(each.scene) for each in scenes)} moments"]
    facts += [f"{sum(len(found.found) for found in first.found.values())} boxes"]
    facts += [f"saga-fg {first.record.version}"] if first.record is not None else []
    return Report(
        f"{' and '.join(each.method for each in results)} on {source.title}",
        facts,
        scenes,
        tables,
        charts,
        first.record.configuration if first.record is not None else "",
        beside=results[1].method if beside is not None else "",
    )


def result_scenes(source: DatasetSource, result: Path, found: Mapping[str, SceneResult]) -> list[ReportScene]:
    """Return the scenes of a result, with edges by the rules of the dataset's default configuration.

    Raises `InputError` for a broken record of the run, or broken predictions.
    """
    record = read_run_record(result)
    return _scenes(source, _Result(record.method if record is not None else "tracks", result, found, record))


def _read(source: DatasetSource, path: Path) -> _Result:
    record = read_run_record(path)
    return _Result(record.method if record is not None else path.stem, path, source.read_results(path), record)


def _with_distinct_names(one: _Result, other: _Result) -> list[_Result]:
    """Give two results different names."""
    if one.method != other.method:
        return [one, other]
    if one.path.stem != other.path.stem:
        return [replace(each, method=each.path.stem) for each in (one, other)]
    return [replace(each, method=f"{each.path.parent.name}/{each.path.stem}") for each in (one, other)]


def _scenes(source: DatasetSource, result: _Result) -> list[ReportScene]:
    config, predicted = load_config(source.family), read_predictions(result.path)
    return [
        ReportScene(
            each.scene,
            {result.method: each.found},
            {} if each.coasting is None else {result.method: each.coasting},
            config.tracker.edges,
            config.sensors,
            {result.method: predicted[name]} if name in predicted else {},
        )
        for name, each in result.found.items()
    ]


def _pairs(
    scenes: Sequence[ReportScene], others: Sequence[ReportScene]
) -> Sequence[tuple[ReportScene, ReportScene | None]]:
    by_name = {each.scene.name: each for each in others}
    if scenes and not any(each.scene.name in by_name for each in scenes):
        raise InputError(f"--beside: expected a scene of the result, e.g. {scenes[0].scene.name}; it has none")
    return [(each, by_name.get(each.scene.name)) for each in scenes]


def _joined(scene: ReportScene, result: _Result, other: ReportScene | None) -> ReportScene:
    """Add the tracks of another result."""
    if other is None:
        return scene
    if not np.array_equal(scene.scene.timestamps, other.scene.timestamps):
        name = scene.scene.name
        raise InputError(f"{result.path}: scene {name}: expected the moments of the other result; give --detections")
    return replace(
        scene,
        tracks={**other.tracks, **scene.tracks},
        coasting={**other.coasting, **scene.coasting},
        predictions={**other.predictions, **scene.predictions},
    )


def _on_the_ground(source: DatasetSource, scenes: Sequence[ReportScene], width: int) -> list[ReportScene]:
    """Add the maps of the places and the images of the cameras."""
    by_name = {each.scene.name: each.scene for each in scenes}
    maps, images = source.maps(by_name), source.images(by_name) if width else {}
    return [
        replace(each, map=maps.get(name), cameras=thumbnails(images.get(name, {}), width))
        for name, each in zip(by_name, scenes, strict=True)
    ]


def _figures(source: DatasetSource, found: Mapping[str, SceneResult]) -> tuple[list[FigureTable], list[Chart]]:
    if source.has_truth:
        evaluation = source.evaluate(found)
        return list(evaluation.tables()), accuracy_charts(evaluation.errors)
    results = list(found.values())
    return [track_figures(results)], track_charts(results)
