"""Tracks scored against the ground truth of their scenes: CLEAR figures and RMSE at every moment, hidden objects too.

It serves datasets that have no official evaluation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from data_tools.evaluation.errors import error_json, error_pictures, error_tables
from data_tools.evaluation.hota import HotaRow, hota, hota_json, hota_table
from data_tools.evaluation.innovations import innovation_json, innovation_table
from data_tools.evaluation.score_sweep import TITLE, best_thresholds, score_sweep, sweep_table
from data_tools.evaluation.summary import summary_table
from data_tools.evaluation.track_quality import track_table
from data_tools.figures import FigureTable, cell
from data_tools.metrics import (
    LabelErrors,
    NuScenesTrackingMetrics,
    SceneBoxes,
    SceneMetrics,
    WholeTracks,
    label_errors,
    scene_metrics_by_label,
    track_summaries,
    whole_tracks,
)
from data_tools.plots import recall_sweep
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene

_TITLE = "Tracks at every moment; MOTP and errors in m; carried error: of the track that last followed a hidden object"
_COLUMNS = (
    *("class", "MOTA", "MOTP", "recall", "IDS", "FP", "FN", "objects", "hidden", "hidden tracked"),
    *("carried error", "carried error median"),
)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The figures of one result over some scenes.

    tracking     table of the tracking metrics
    programs     the same figures by name, with the names of the scenes
    errors       at labels
    tracks       as wholes, of all scenes
    hota         empty where it was not asked for
    innovations  squared distances in sigmas by class; empty where they are not known
    draw         makes pictures of the tracking metrics by name
    sweep        over scores; None where it was not asked for
    """

    tracking: FigureTable
    programs: Mapping[str, Any]
    errors: LabelErrors
    tracks: WholeTracks
    hota: Sequence[HotaRow] = ()
    innovations: Mapping[str, FloatArray] = field(default_factory=dict)
    draw: Callable[[], Mapping[str, Any]] = dict
    sweep: NuScenesTrackingMetrics | None = None

    def summary(self) -> FigureTable | None:
        """One narrow table of what matters most, None without the sweep over scores."""
        return None if self.sweep is None else summary_table(self.sweep, self.errors, self.hota)

    def tables(self) -> list[FigureTable]:
        """Tables for people."""
        innovations = [innovation_table(self.innovations)] if self.innovations else []
        return [
            self.tracking,
            *([] if self.sweep is None else [sweep_table(TITLE, self.sweep)]),
            *error_tables(self.errors),
            track_table(self.tracks),
            *innovations,
            *([hota_table(self.hota)] if self.hota else []),
        ]

    def figures(self) -> dict[str, Any]:
        """Figures for programs."""
        swept = {} if self.sweep is None else {"sweep": {"overall": self.sweep.overall, **self.sweep.per_class}}
        return {
            **self.programs,
            **swept,
            **error_json(self.errors),
            "tracks": track_summaries(self.tracks),
            "innovations": innovation_json(self.innovations),
            "hota": hota_json(self.hota),
        }

    def pictures(self) -> dict[str, Any]:
        """matplotlib figures by name."""
        return {**self.draw(), **error_pictures(self.errors)}


def evaluate_tracks(
    results: Sequence[tuple[Scene, SceneBoxes]],
    with_hota: bool = False,
    innovations: Mapping[str, FloatArray] | None = None,
    sweep: bool = False,
) -> Evaluation:
    """Score the tracks found in some scenes, class by class, pooled over the scenes.

    sweep        over scores, too (AMOTA); HOTA is then of the tracks from the score of the best MOTA on, else of all
    innovations  squared distances of the run by class, to be among the figures

    Raises `InputError` for a scene without ground truth, `MissingExtraError` for HOTA without trackeval.
    """
    by_label: dict[str, list[SceneMetrics]] = {}
    errors, tracks, pairs = [], [], []
    for scene, found in results:
        if scene.ground_truth is None:
            raise InputError(f"scene {scene.name}: expected ground truth")
        for label, metrics in scene_metrics_by_label(scene.ground_truth, found.by_frame(len(scene))).items():
            by_label.setdefault(label, []).append(metrics)
        visible = SceneBoxes.of_annotations(scene.ground_truth, hidden=False)
        errors.append(label_errors(visible, found, visible.boxes.velocity))
        pairs.append((SceneBoxes.of_annotations(scene.ground_truth), found))
        tracks.append(whole_tracks(*pairs[-1]))
    pooled = {label: SceneMetrics.pool(parts) for label, parts in sorted(by_label.items())}
    swept = score_sweep(results) if sweep else None
    thresholds = dict.fromkeys(pooled, 0.0) if swept is None else best_thresholds(swept)
    whole = {"overall": SceneMetrics.pool(pooled.values()), **pooled}
    return Evaluation(
        FigureTable(_TITLE, _COLUMNS, tuple((name, *_cells(metrics)) for name, metrics in whole.items())),
        {
            "scenes": tuple(scene.name for scene, _ in results),
            "tracking": {name: _figures(metrics) for name, metrics in whole.items()},
        },
        LabelErrors.pool(errors),
        WholeTracks.concatenate(tracks),
        hota(pairs, thresholds) if with_hota else (),
        innovations or {},
        dict if swept is None else lambda: {"recall": recall_sweep(swept.curves)},
        swept,
    )


def _cells(m: SceneMetrics) -> tuple[str, ...]:
    counts = (m.switches, m.false_positives, m.misses, m.objects, m.hidden_objects)
    shares = (cell(m.mota), cell(m.motp), cell(m.recall))
    return (*shares, *map(cell, counts), cell(m.hidden_recall), cell(m.carried.rmse), cell(m.carried.median))


def _figures(m: SceneMetrics) -> dict[str, float]:
    names = ("mota", "motp", "recall", "switches", "false_positives", "misses", "objects", "hidden_objects")
    figures = {name: getattr(m, name) for name in (*names, "hidden_recall")}
    samples = {"position": m.position, "velocity": m.velocity, "heading": m.heading, "carried": m.carried}
    samples |= {"hidden_position": m.hidden_position, "hidden_velocity": m.hidden_velocity}
    return figures | {f"{name}_rmse": sample.rmse for name, sample in samples.items()}
