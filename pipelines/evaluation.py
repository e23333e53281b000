"""Labels beside online tracks and detections, against ground truth, and the figures of a whole dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_tools.datasets.detection_files import read_tracks
from data_tools.datasets.results import SceneResult, scene_result
from data_tools.datasets.source import DatasetSource
from data_tools.evaluation import placed_detections
from data_tools.figures import FigureTable, cell, write_figures
from data_tools.files import write_text
from data_tools.metrics import SceneBoxes, coverages
from data_tools.metrics.labels import (
    CommonBoxes,
    LabelledScene,
    PrecisionRecall,
    common_boxes,
    precision_recall,
    scored_pairs,
)
from pipelines.config import Method
from pipelines.report import report_page, result_report
from pipelines.report.page import RunRecord, write_run_record
from pipelines.smoothing import SmoothConfig
from pipelines.tracking import Progress, track_scene
from saga_fg import Dataset, InputError, Scene
from saga_fg.model import sensor_model

if TYPE_CHECKING:
    from data_tools.evaluation import Evaluation

DISTANCES = (0.5, 1.0, 2.0)  # m
PRECISIONS = (0.9, 0.8, 0.7)
RANGES = ((0.0, 20.0), (20.0, 40.0), (40.0, np.inf))  # m
SYSTEMS = ("detections", "online", "labels")


@dataclass(frozen=True, eq=False)
class LabelEvaluation:
    """The figures of labels over some scenes.

    curves  by distance (m) and system
    same    by distance: the true boxes that all systems match
    """

    scenes: tuple[str, ...]
    curves: Mapping[float, Mapping[str, PrecisionRecall]]
    same: Mapping[float, CommonBoxes]

    def tables(self) -> list[FigureTable]:
        """Tables for people."""
        return [_recall_table(self.curves), *map(_group_table, self._groups()), _calibration_table(self.same[2.0])]

    def figures(self) -> dict[str, Any]:
        """Figures for programs."""
        return {
            "scenes": self.scenes,
            "precision_recall": {
                str(distance): {
                    name: {
                        "whole": curve.whole,
                        "best_f1": curve.best,
                        "recall_at": {str(p): curve.recall_at(p) for p in PRECISIONS},
                    }
                    for name, curve in curves.items()
                }
                for distance, curves in self.curves.items()
            },
            "common_boxes": {
                title: {group: _json_of(boxes) for group, boxes in groups.items()} for title, groups in self._groups()
            },
        }

    def _groups(self) -> list[tuple[str, dict[str, CommonBoxes]]]:
        """Tables of the same boxes: by distance of the match, class, range, and whether they could be seen."""
        visible = {d: same.select(same.visible) for d, same in self.same.items()}
        wide = visible[2.0]
        far = {f"{a:g} to {b:g} m": wide.select((wide.distance >= a) & (wide.distance < b)) for a, b in RANGES}
        hidden = self.same[2.0].select(~self.same[2.0].visible)
        return [
            ("matched within", {f"{d:g} m": same for d, same in visible.items()}),
            ("class", {str(c): wide.select(wide.label == c) for c in np.unique(wide.label)}),
            ("range", far),
            ("occlusion", {"visible": wide, "hidden": hidden}),
        ]


def evaluate_labels(
    table: str | Path,
    dataset: Dataset,
    config: SmoothConfig,
    method: Method = "saga",
    progress: Progress | None = None,
) -> LabelEvaluation:
    """Judge a table of labels by the dataset it was made of; the online tracks are made anew, as `config` says.

    The scenes are those in the table. Raises `InputError` for a table that is missing, broken or empty, and for
    scenes and moments that the dataset does not have, or without ground truth.
    """
    rows = read_tracks(table, labels=True)
    if len(rows.source) == 0:
        raise InputError(f"{table}: expected labels, there are none")
    labelled: dict[str, LabelledScene] = {}
    for name in np.unique(rows.scene).tolist():
        scene = dataset.scene(name)
        if scene.ground_truth is None:
            raise InputError(f"scene {name}: expected ground truth, there is none")
        online = track_scene(scene, config.tracking.new_tracker(method), progress)
        systems = {
            "detections": _detections(scene, config),
            "online": SceneBoxes.of_tracks(online.tracks),
            "labels": scene_result(scene, rows, table).found,
        }
        labelled[name] = _labelled(scene, systems)
    curves: dict[float, dict[str, PrecisionRecall]] = {}
    same: dict[float, CommonBoxes] = {}
    for distance in DISTANCES:
        curves[distance] = {
            system: precision_recall(
                [scored_pairs(s.truth, s.visible, s.systems[system], distance) for s in labelled.values()]
            )
            for system in SYSTEMS
        }
        same[distance] = CommonBoxes.concatenate([common_boxes(scene, distance) for scene in labelled.values()])
    return LabelEvaluation(tuple(labelled), curves, same)


def _detections(scene: Scene, config: SmoothConfig) -> SceneBoxes:
    """The detections taken at the scene's moments, each an object of its own, scores as probabilities."""
    moment, boxes = placed_detections(scene)
    moments = set(scene.timestamps.tolist())
    scores = [
        sensor_model(config.tracking.sensors, frame.sensor).probability(
            frame.detections.score, frame.detections.boxes.label
        )
        for frame in scene.frames
        if frame.timestamp in moments
    ]
    return SceneBoxes(moment, np.arange(len(boxes)).astype(np.str_), boxes, np.concatenate([np.empty(0), *scores]))


def _labelled(scene: Scene, systems: Mapping[str, SceneBoxes]) -> LabelledScene:
    assert scene.ground_truth is not None
    truth = SceneBoxes.of_annotations(scene.ground_truth)
    visible = np.concatenate([np.empty(0, dtype=np.bool_), *(moment.visible for moment in scene.ground_truth)])
    place = scene.world_T_ego[truth.frame][:, :2, 3]
    distance = np.hypot(*(truth.boxes.position[:, :2] - place).T)
    return LabelledScene(truth, visible, truth.boxes.velocity, distance, systems)


def _recall_table(curves: Mapping[float, Mapping[str, PrecisionRecall]]) -> FigureTable:
    rows = []
    for distance, by_system in curves.items():
        level = by_system["online"].best[0]  # the precision at which the online tracks have their best F1
        for name, curve in by_system.items():
            at = (curve.recall_at(p) for p in (level, *PRECISIONS))
            rows.append((f"{name}, {distance:g} m", *(cell(v) for v in (*curve.whole, *curve.best, *at))))
    columns = ("within", "precision", "recall", "precision at best F1", "recall", "recall at online's precision")
    title = "Precision and recall: of all boxes, at the best F1 over a score threshold, and recall at equal precision"
    return FigureTable(title, (*columns, *(f"at {p:g}" for p in PRECISIONS)), tuple(rows))


def _group_table(group: tuple[str, Mapping[str, CommonBoxes]]) -> FigureTable:
    title, parts = group
    columns = (
        *(title, "boxes", "position: detections", "online", "labels", "labels / online", "labels / detections"),
        *("heading: detections", "online", "labels", "size: detections", "online", "labels"),
        *("velocity: online", "labels"),
    )
    rows = tuple((name, cell(len(same)), *_errors(same)) for name, same in parts.items())
    return FigureTable(f"RMSE on the same boxes, by {title}: m, degrees, m/s", columns, rows)


def _errors(same: CommonBoxes) -> tuple[str, ...]:
    position = {name: same.sample(name, "position").rmse for name in SYSTEMS}
    heading = (cell(float(np.degrees(same.sample(name, "heading").rmse)), 1) for name in SYSTEMS)
    ratios = (position["labels"] / (position[name] or np.nan) for name in ("online", "detections"))
    size = (cell(same.sample(name, "size").rmse) for name in SYSTEMS)
    velocity = (cell(same.sample(name, "velocity").rmse) for name in ("online", "labels"))
    return (*map(cell, position.values()), *map(cell, ratios), *heading, *size, *velocity)


def _calibration_table(same: CommonBoxes) -> FigureTable:
    rows = []
    visible = same.select(same.visible)
    for label in ("all", *np.unique(visible.label).tolist()):
        part = visible if label == "all" else visible.select(visible.label == label)
        for name in ("online", "labels"):
            values = part.sample(name, "nees").values
            covered = (cell(share) for share in coverages(values).values())
            mean = cell(float(values.mean() / 2) if len(values) else float("nan"), 2)
            rows.append((f"{label}, {name}", cell(len(values)), mean, *covered))
    columns = ("class", "boxes", "ANEES / 2", "in 50 %", "in 90 %", "in 99 %")
    return FigureTable("Calibration: share of position errors within the stated ellipses", columns, tuple(rows))


def _json_of(same: CommonBoxes) -> dict[str, Any]:
    rmse = {
        name: {q: same.sample(name, q).rmse for q in ("position", "heading", "size", "velocity")} for name in SYSTEMS
    }
    coverage = {name: coverages(same.sample(name, "nees").values) for name in ("online", "labels")}
    return {"boxes": len(same), "rmse": rmse, "coverage": coverage}


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
