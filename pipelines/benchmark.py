"""The figures of a benchmark from the tracks of all its scenes, and the page that shows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_tools.datasets.results import SceneResult
from data_tools.datasets.source import DatasetSource
from data_tools.figures import write_figures
from data_tools.files.atomic_files import write_text
from pipelines.report import report_page, result_report
from pipelines.report.charts import accuracy_charts
from pipelines.report.run_record import RunRecord, write_run_record

if TYPE_CHECKING:
    from data_tools.evaluation import Evaluation

SHOWN = 3  # scenes in the player: a page of them all would be too large


def judge_run(source: DatasetSource, output: Path, method: str, configuration: str, hota: bool) -> Evaluation:
    """Score the tracks of all scenes of a run in a folder; figures.json and report.html appear in it.

    configuration: YAML of the run. Raises `InputError` for results that do not fit the ground truth.
    """
    result = output / source.all_tracks
    write_run_record(result, RunRecord(method, configuration, {}))
    found = source.read_results(result)
    evaluation = source.evaluate(found, hota)
    figures: dict[str, Any] = {"method": method, "version": version("saga-fg"), "figures": evaluation.figures()}
    write_figures(output / "figures.json", figures)
    write_text(output / "report.html", _page(source, result, found, evaluation))
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
            charts=accuracy_charts(evaluation.errors),
        )
    )
