"""Evaluation of results: CLEAR, HOTA, AMOTA, errors and calibration, as tables and for programs.

Tracks scored against the ground truth of their scenes: CLEAR figures and RMSE at every moment, hidden objects too.

It serves datasets that have no official evaluation.

HOTA, CLEAR and Identity figures of a result, class by class, in the plane (2D) and in space (3D).

These metrics judge one set of tracks, without a sweep over scores. The tracks scored are those whose mean score reaches
the class's threshold of best MOTA, as published figures choose them too.

Innovations and their covariances by class (NIS): the tracks and the noise of the detections together.

The squared distance in sigmas of a track and the detection it took has 2 degrees of freedom: its mean is 2 if both
covariances are right. What lies outside the gate is never matched, which lowers the mean by little.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from data_tools.figures import FEWEST, Chart, Column, FigureTable, Series, cell, distribution
from data_tools.metrics import (
    EllipseCoverage,
    HotaMetrics,
    LabelErrors,
    NuScenesTrackingMetrics,
    RecallCurves,
    SceneBoxes,
    SceneMetrics,
    Similarity,
    best_thresholds,
    calibration,
    coverages,
    error_summary,
    errors_by_class,
    hota_metrics,
    label_errors,
    match_scene,
    placed_detections,
    scene_metrics_by_label,
    score_sweep,
)
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray, StrArray
from saga_fg.parts import new_part, of_own_code, part_kind
from saga_fg.types import Annotations, Scene, html_table, text_table

__all__ = [
    "Evaluation",
    "Metric",
    "evaluate_tracks",
]

_CLASS = ("class",)
_ERRORS = (
    Column("labels", "labels"),
    Column("with track", "tracked"),
    Column("position", "position"),
    Column("detection", "detection"),
    Column("velocity", "velocity"),
    Column("velocity parked", "velocity_parked"),
    Column("velocity moving", "velocity_moving"),
    Column("unknown", "velocity_unknown"),
    Column("heading", "heading", 1, 180 / np.pi),
    Column("flipped", "flipped"),
)
_CALIBRATION = ("class", "objects", "boxes", "ANEES / 2", "median", "in 50 %", "in 90 %", "in 99 %", "verdict")


def error_tables(errors: LabelErrors) -> list[FigureTable]:
    """RMSE of tracks (and of detections) at the labels; and, if there are covariances, how well they fit."""
    classes = errors_by_class(errors)
    title = "RMSE at labels: position in m, velocity in m/s, heading in degrees"
    tables = [FigureTable.of(title, _CLASS, _ERRORS, (((name,), error_summary(e)) for name, e in classes.items()))]
    calibrations = {name: calibration(e) for name, e in classes.items()}
    if any(c.boxes for c in calibrations.values()):
        title = "Calibration: share of errors within the tracks' ellipses; ANEES / 2 and median: 1 is right"
        rows = tuple((name, *_calibration_cells(c)) for name, c in calibrations.items())
        tables.append(FigureTable(title, _CALIBRATION, rows))
    return tables


def error_json(errors: LabelErrors) -> dict[str, Any]:
    """Errors and calibration by class, for programs."""
    classes = errors_by_class(errors)
    fits = {name: calibration(e) for name, e in classes.items()}
    return {
        "errors": {name: error_summary(e) for name, e in classes.items()},
        "calibration": {
            name: {
                **{
                    field: getattr(c, field)
                    for field in ("objects", "boxes", "anees", "median_nees", "coverage", "enough_data")
                },
                "consistent": c.consistent if c.enough_data else None,
            }
            for name, c in fits.items()
        },
    }


SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)


def accuracy_charts(errors: LabelErrors) -> list[Chart]:
    """Charts, if they have data: errors at labels by class, and the shares that the tracks' ellipses hold."""
    classes = {name: of_class for name, of_class in errors_by_class(errors).items() if name != "overall"}
    charts = [
        distribution(
            f"{title} at labels",
            unit,
            "share of labels below",
            [(name, e.sample(field).values * scale) for name, e in classes.items()],
        )
        for title, unit, field, scale in (
            ("Position error", "m", "position", 1.0),
            ("Velocity error", "m/s", "velocity", 1.0),
            ("Heading error", "degrees", "heading", 180 / np.pi),
        )
    ]
    held = [Series("right", (0.0, 1.0), (0.0, 1.0), faint=True)]
    for name, of_class in classes.items():
        known = of_class.nees[np.isfinite(of_class.nees)]
        if len(known) >= FEWEST:
            held.append(Series(name, SHARES, list(coverages(known, SHARES).values())))
    calibrated = Chart("Calibration of positions", "share that the ellipse should hold", "share that it holds", held)
    return [chart for chart in charts if chart.series] + [calibrated] * (len(held) > 1)


def recall_charts(curves: Mapping[str, RecallCurves]) -> list[Chart]:
    """Charts of what each class pays for more recall, up to the recall that it reaches.

    AMOTA and AMOTP are the means of the first and the last one over the recall that is asked for; recall that is not
    reached counts with 0 and with 2 m.
    """
    charts = []
    for name, title in (("motar", "MOTAR"), ("mota", "MOTA"), ("ids", "identity switches"), ("motp", "MOTP, m")):
        series = []
        for label, curve in curves.items():
            values = getattr(curve, name)
            reached = np.isfinite(values) & np.isfinite(curve.score)
            series.append(Series(label, curve.hypothetical_recall[reached].tolist(), values[reached].tolist()))
        charts.append(Chart(title, "recall", title, series))
    return charts


def _calibration_cells(c: EllipseCoverage) -> tuple[str, ...]:
    verdict = ("consistent" if c.consistent else "inconsistent") if c.enough_data else "too few boxes"
    shares = (cell(share) for share in c.coverage.values())
    return (cell(c.objects), cell(c.boxes), cell(c.anees, 2), cell(c.median_nees, 2), *shares, verdict)


SIMILARITIES: dict[str, Similarity] = {"2D": "bev_iou", "3D": "iou_3d"}
_HOTA = (
    Column("score >=", "threshold"),
    *(Column(name, f"figures.{name.lower()}", 2, 100) for name in ("HOTA", "DetA", "AssA", "LocA", "MOTA", "MOTP")),
    Column("IDS", "figures.ids"),
    Column("FRAG", "figures.frag"),
    *(Column(name, f"figures.{name.lower()}", 2, 100) for name in ("IDF1", "IDP", "IDR")),
)


@dataclass(frozen=True, eq=False)
class HotaRow:
    """One class at one similarity: `overlap` is 2D, 3D or image; `threshold`: least mean score of its tracks."""

    label: str
    overlap: str
    threshold: float
    figures: HotaMetrics


def hota(scenes: Sequence[tuple[SceneBoxes, SceneBoxes]], thresholds: Mapping[str, float]) -> list[HotaRow]:
    """Judge (truth, found) of all scenes for the classes of `thresholds`. Raises `MissingExtraError` w/o trackeval."""
    rows = []
    similarities = _similarities(scenes)
    for label, threshold in thresholds.items():
        scored = [(truth, _surer(found, label, threshold)) for truth, found in scenes]
        for overlap, similarity in similarities.items():
            rows.append(HotaRow(label, overlap, threshold, hota_metrics(scored, label, similarity)))
    return rows


def _similarities(scenes: Sequence[tuple[SceneBoxes, SceneBoxes]]) -> dict[str, Similarity]:
    """The overlaps that all boxes have; where sizes or headings are missing, the nearness of centres, 0 from 4 m on."""
    tables = [table.boxes for one in scenes for table in one]
    plane = all(np.isfinite(boxes.size[:, :2]).all() and np.isfinite(boxes.yaw).all() for boxes in tables)
    if not plane:
        return {"centre": "centre"}
    if not all(np.isfinite(boxes.size[:, 2]).all() for boxes in tables):
        return {"2D": "bev_iou"}
    return SIMILARITIES


def hota_table(rows: Sequence[HotaRow]) -> FigureTable:
    """Table for people, in percent as such figures are published."""
    title = "HOTA, CLEAR and Identity, in %; pairs from an overlap of 0.5 on count for CLEAR and Identity"
    return FigureTable.of(title, (*_CLASS, "overlap"), _HOTA, (((row.label, row.overlap), row) for row in rows))


def hota_json(rows: Sequence[HotaRow]) -> dict[str, Any]:
    """Figures for programs, by class and overlap."""
    result: dict[str, Any] = {}
    for row in rows:
        result.setdefault(row.label, {"threshold": row.threshold})[row.overlap] = row.figures
    return result


def _surer(found: SceneBoxes, label: str, threshold: float) -> SceneBoxes:
    """The tracks of a class whose mean score is at least `threshold`."""
    rows = np.flatnonzero(found.boxes.label == label)
    return found.select(rows[mean_scores(found.id[rows], found.score[rows]) >= threshold - 1e-12])


def mean_scores(track: IntArray | StrArray, score: FloatArray) -> FloatArray:
    """(N,) the mean score of each box's track."""
    _, number = np.unique(track, return_inverse=True)
    return np.asarray((np.bincount(number, weights=score) / np.maximum(np.bincount(number), 1))[number])


_INNOVATION_COLUMNS = ("class", "matches", "NIS / 2", "median", "in 50 %", "in 90 %", "in 99 %")


def innovation_table(by_class: Mapping[str, FloatArray]) -> FigureTable:
    """Table for people."""
    title = "Innovations: NIS / 2 and median are 1 if the covariances of tracks and detections are right"
    return FigureTable(
        title, _INNOVATION_COLUMNS, tuple((label, *_innovation_cells(values)) for label, values in by_class.items())
    )


def innovation_json(by_class: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Figures for programs."""
    return {
        label: {"matches": len(values), "nis": values.mean() / 2, "median": _median(values), "held": coverages(values)}
        for label, values in by_class.items()
    }


def _innovation_cells(values: FloatArray) -> tuple[str, ...]:
    shares = (cell(share) for share in coverages(values).values())
    return (cell(len(values)), cell(float(values.mean()) / 2, 2), cell(_median(values), 2), *shares)


def _median(values: FloatArray) -> float:
    """Over that of the chi-square distribution with 2 degrees of freedom."""
    return float(np.median(values) / (2 * np.log(2)))


TITLE = "Over all scores, as in the nuScenes tracking task, without a limit of range; the rest at the best MOTA"
_SWEEP = (
    *(Column(name, name.lower()) for name in ("AMOTA", "AMOTP", "MOTA", "MOTP", "recall")),
    *(Column(name, name.lower(), 0) for name in ("IDS", "FRAG", "TP", "FP", "FN", "GT", "MT", "ML")),
    *(Column(name, name.lower(), 2) for name in ("FAF", "TID", "LGD")),
)


def sweep_table(title: str, metrics: NuScenesTrackingMetrics) -> FigureTable:
    """The figures of the task, a row for all classes and one for each."""
    rows = {"overall": metrics.overall, **metrics.per_class}
    return FigureTable.of(title, _CLASS, _SWEEP, (((name,), figures) for name, figures in rows.items()))


@part_kind("metric", "saga_fg.metrics")
class Metric(Protocol):
    """A metric of a user's own."""

    def __call__(self, scenes: Sequence[tuple[SceneBoxes, SceneBoxes]]) -> Mapping[str, float]:
        """Figures by name, of (true boxes, tracks) of all scenes, world coordinates."""


def own_figures(
    results: Sequence[tuple[Scene, SceneBoxes]], metrics: Iterable[str | Metric]
) -> dict[str, dict[str, float]]:
    """The figures of a user's metrics, by the name of each. Raises `InputError` for what is none, naming it."""
    if callable(metrics) or isinstance(metrics, str):
        raise InputError("metrics: expected a list of metrics")
    found: dict[str, dict[str, float]] = {}
    pairs = [(SceneBoxes.of_annotations(scene.ground_truth or ()), boxes) for scene, boxes in results]
    for given in metrics:
        metric: Metric = new_part("metric", given, Metric)
        name = given if isinstance(given, str) else getattr(metric, "__name__", type(metric).__name__)
        with of_own_code(f"metric: {name}"):
            figures = metric(pairs)
            if not isinstance(figures, Mapping):
                raise InputError(f"expected figures by name, got {type(figures).__name__}")
            found[name] = {str(key): float(value) for key, value in figures.items()}
    return found


LEGEND = (
    "AMOTA: mean over all scores. score: that of the best MOTA; from it on HOTA,\n"
    "MOTA, recall, identity switches (IDS), false boxes (FP). m, m/s: RMSE of places\n"
    "and velocities. in 90 %: share of errors in 90 % ellipses (right: 0.90)."
)
_SUMMARY_COLUMNS = ("class", "AMOTA", "HOTA", "score", "MOTA", "recall", "IDS", "FP", "m", "m/s", "in 90 %")
_LONGEST = 14  # characters of a class


def summary_table(sweep: NuScenesTrackingMetrics, errors: LabelErrors, hota: Sequence[HotaRow] = ()) -> FigureTable:
    """One row for all classes and one for each that has true objects; HOTA by the first overlap there is."""
    by_class, scores = errors_by_class(errors), best_thresholds(sweep)
    quality: dict[str, float] = {}
    for row in hota:
        quality.setdefault(row.label, row.figures.hota)
    quality["overall"] = float(np.mean([quality[label] for label in scores if label in quality] or [np.nan]))
    rows = []
    for label in ("overall", *scores):
        f = sweep.overall if label == "overall" else sweep.per_class[label]
        error, fit = (
            (error_summary(by_class[label]), calibration(by_class[label])) if label in by_class else (None, None)
        )
        shares = (f.amota, quality.get(label, np.nan), scores.get(label, np.nan), f.mota, f.recall)
        rows.append(
            (
                label if len(label) <= _LONGEST else f"{label[: _LONGEST - 1]}~",
                *(cell(value, 2) for value in shares),
                *(cell(value, 0) for value in (f.ids, f.fp)),
                *(cell(value, 2) for value in ((error.position, error.velocity) if error else (np.nan, np.nan))),
                cell(fit.coverage[0.9] if fit and fit.boxes else np.nan, 2),
            )
        )
    return FigureTable("Tracks beside the ground truth", _SUMMARY_COLUMNS, tuple(rows))


_MOMENT_TITLE = (
    "Tracks at every moment; MOTP and errors in m; carried error: of the track that last followed a hidden object"
)
_MOMENTS = (
    Column("MOTA", "mota"),
    Column("MOTP", "motp"),
    Column("recall", "recall"),
    Column("IDS", "switches"),
    Column("FP", "false_positives"),
    Column("FN", "misses"),
    Column("objects", "objects"),
    Column("hidden", "hidden_objects"),
    Column("hidden tracked", "hidden_recall"),
    Column("carried error", "carried.rmse"),
    Column("carried error median", "carried.median"),
)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The figures of one result over some scenes.

    tracking     table of the tracking metrics
    programs     the same figures by name, with the names of the scenes
    errors       at labels
    hota         empty where it was not asked for
    innovations  squared distances in sigmas by class; empty where they are not known
    curves       of the tracking metrics over recall, by class; empty where there are none
    sweep        over scores; None where it was not asked for
    own          figures of a user's metrics by their names
    """

    tracking: FigureTable
    programs: Mapping[str, Any]
    errors: LabelErrors
    hota: Sequence[HotaRow] = ()
    innovations: Mapping[str, FloatArray] = field(default_factory=dict)
    curves: Mapping[str, RecallCurves] = field(default_factory=dict)
    sweep: NuScenesTrackingMetrics | None = None
    own: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __repr__(self) -> str:
        """The summary, or the figures of tracking, and a user's own, as tables for a terminal."""
        shown = (self.summary() or self.tracking, *self.own_tables())
        return "\n".join(text_table(table.title, table.columns, table.rows) for table in shown)

    def _repr_html_(self) -> str:
        """The tables for a notebook."""
        shown = self.summary()
        tables = [*([] if shown is None else [shown]), *self.tables()]
        return "".join(html_table(table.title, table.columns, table.rows) for table in tables)

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
            *innovations,
            *([hota_table(self.hota)] if self.hota else []),
            *self.own_tables(),
        ]

    def own_tables(self) -> list[FigureTable]:
        """Tables of a user's metrics."""
        return [FigureTable(name, ("figure", "value"), _cells_of(figures)) for name, figures in self.own.items()]

    def figures(self) -> dict[str, Any]:
        """Figures for programs."""
        swept = {} if self.sweep is None else {"sweep": {"overall": self.sweep.overall, **self.sweep.per_class}}
        return {
            **self.programs,
            **swept,
            **error_json(self.errors),
            "innovations": innovation_json(self.innovations),
            "hota": hota_json(self.hota),
            **({"own": self.own} if self.own else {}),
        }

    def charts(self) -> list[Chart]:
        """Charts of recall, errors and calibration, those that there are."""
        return [*recall_charts(self.curves), *accuracy_charts(self.errors)]


def beside_hidden(truth: Sequence[Annotations], found: SceneBoxes) -> SceneBoxes:
    """The boxes found of a scene but those of hidden objects, which are neither right nor wrong."""
    if all(now.visible.all() for now in truth):
        return found
    kept, first = np.ones(len(found), dtype=np.bool_), np.searchsorted(found.frame, np.arange(len(truth)))
    for begin, now, match in zip(first, truth, match_scene(truth, found.by_frame(len(truth))), strict=True):
        kept[begin + match.track_row[~now.visible[match.object_row]]] = False
    return found.select(kept)


def evaluate_tracks(
    results: Sequence[tuple[Scene, SceneBoxes]],
    with_hota: bool = False,
    innovations: Mapping[str, FloatArray] | None = None,
    sweep: bool = False,
    detected: bool = False,
) -> Evaluation:
    """Score the tracks found in some scenes, class by class, pooled over the scenes.

    detected     errors are those at the true objects that a detection matches, beside the detections' own
    sweep        over scores, too (AMOTA); HOTA is then of the tracks from the score of the best MOTA on, else of all
    innovations  squared distances of the run by class, to be among the figures

    Raises `InputError` for a scene without ground truth, `MissingExtraError` for HOTA without trackeval.
    """
    by_label: dict[str, list[SceneMetrics]] = {}
    errors, pairs, judged = [], [], []
    for scene, found in results:
        if scene.ground_truth is None:
            raise InputError(f"scene {scene.name}: expected ground truth")
        for label, metrics in scene_metrics_by_label(scene.ground_truth, found.by_frame(len(scene))).items():
            by_label.setdefault(label, []).append(metrics)
        visible = SceneBoxes.of_annotations(scene.ground_truth, hidden=False)
        errors.append(
            label_errors(visible, found, visible.boxes.velocity, placed_detections(scene) if detected else None)
        )
        judged.append((scene, beside_hidden(scene.ground_truth, found)))
        pairs.append((visible, judged[-1][1]))
    pooled = {label: SceneMetrics.pool(parts) for label, parts in sorted(by_label.items())}
    swept = score_sweep(judged) if sweep else None
    thresholds = dict.fromkeys(pooled, 0.0) if swept is None else best_thresholds(swept)
    whole = {"overall": SceneMetrics.pool(pooled.values()), **pooled}
    return Evaluation(
        tracking=FigureTable.of(
            _MOMENT_TITLE, _CLASS, _MOMENTS, (((name,), metrics) for name, metrics in whole.items())
        ),
        programs={
            "scenes": tuple(scene.name for scene, _ in results),
            "tracking": {name: _figures(metrics) for name, metrics in whole.items()},
        },
        errors=LabelErrors.pool(errors),
        hota=hota(pairs, thresholds) if with_hota else (),
        innovations=innovations or {},
        curves={} if swept is None else swept.curves,
        sweep=swept,
    )


def _cells_of(figures: Mapping[str, float]) -> tuple[tuple[str, str], ...]:
    return tuple((name, cell(value)) for name, value in figures.items())


def _figures(m: SceneMetrics) -> dict[str, float]:
    names = ("mota", "motp", "recall", "switches", "false_positives", "misses", "objects", "hidden_objects")
    figures = {name: getattr(m, name) for name in (*names, "hidden_recall")}
    samples = {"position": m.position, "velocity": m.velocity, "heading": m.heading, "carried": m.carried}
    samples |= {"hidden_position": m.hidden_position, "hidden_velocity": m.hidden_velocity}
    return figures | {f"{name}_rmse": sample.rmse for name, sample in samples.items()}
