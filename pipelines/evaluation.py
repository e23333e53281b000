"""Labels beside online tracks, against ground truth, and the figures of a whole dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from data_tools.datasets.detection_files import TrackRows
from data_tools.datasets.results import SceneResult, table_results
from data_tools.datasets.source import DatasetSource
from data_tools.evaluation import Evaluation, evaluate_tracks
from data_tools.figures import write_figures
from data_tools.files import write_text
from data_tools.metrics import SceneBoxes
from pipelines.config import Method
from pipelines.report import report_page, result_report
from pipelines.report.page import RunRecord, write_run_record
from pipelines.smoothing import SmoothConfig
from pipelines.tracking import Progress, track_scene
from saga_fg import Dataset, InputError


def evaluate_labels(
    rows: TrackRows,
    table: Path,
    dataset: Dataset,
    config: SmoothConfig,
    method: Method = "saga",
    progress: Progress | None = None,
) -> dict[str, Evaluation]:
    """Judge labels, and online tracks that are made anew as `config` says, by the dataset they were made of.

    rows   of the table of labels, whose scenes are judged; table: its file, for errors

    Errors are those at the true objects that a detection matches. Of the table, the moments nearest to the ground truth
    count. Raises `InputError` for an empty table, and for scenes and moments that the dataset does not have, or without
    ground truth.
    """
    if not len(rows.source):
        raise InputError(f"{table}: expected labels, there are none")
    online, labels = [], []
    for name, found in table_results(rows, table, dataset, judged=True).items():
        scene = found.scene
        if scene.ground_truth is None:
            raise InputError(f"scene {name}: expected ground truth, there is none")
        tracked = track_scene(scene, config.tracking.new_tracker(method), progress)
        online.append((scene, SceneBoxes.of_tracks(tracked.tracks)))
        labels.append((scene, found.found))
    systems = {"online": online, "labels": labels}
    return {name: evaluate_tracks(each, sweep=True, detected=True) for name, each in systems.items()}


SHOWN = 3  # scenes in the player: a page of them all would be too large


def judge_run(source: DatasetSource, output: Path, method: str, configuration: str, hota: bool) -> Evaluation:
    """Score the tracks of all scenes of a run in a folder; figures.json and report.html appear in it.

    configuration: YAML of the run. Raises `InputError` for results that do not fit the ground truth.
    """
    result = output / source.written.all_tracks
    write_run_record(result, RunRecord(method, configuration, {}))
    found = source.read_results(result)
    evaluation = found.evaluate(hota)
    figures: dict[str, Any] = {"method": method, "version": version("saga-fg"), "figures": evaluation.figures()}
    write_figures(output / "figures.json", figures)
    write_text(output / "report.html", _page(source, result, found.scenes, evaluation))
    return evaluation


def _page(source: DatasetSource, result: Path, found: Mapping[str, SceneResult], evaluation: Evaluation) -> str:
    """A page with the figures of all scenes and the first few of them in the player."""
    names = list(found)
    some = result_report(source.restricted(names[:SHOWN]), result)
    boxes = sum(len(each.found) for each in found.values())
    facts = [f"{len(names)} scenes, {boxes} boxes", f"saga-fg {version('saga-fg')}"]
    notes = [f"The player shows {SHOWN} of {len(names)} scenes."] if len(names) > SHOWN else []
    return report_page(
        replace(
            some,
            facts=facts,
            notes=[*notes, *some.notes],
            tables=list(evaluation.tables()),
            charts=evaluation.charts(),
        )
    )
