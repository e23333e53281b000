"""Figures of a report: the time of the tracker, and tracks without ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from data_tools.datasets.results import SceneResult
from data_tools.figures import Chart, FigureTable, Series, cell, distribution
from data_tools.metrics import SceneBoxes
from saga_fg.numerics import Columns, FloatArray, StrArray
from saga_fg.types import Boxes


def latency_chart(milliseconds: FloatArray) -> Chart:
    """Return the distribution of the tracker's time for a frame; milliseconds (N,), N > 0."""
    edges = np.histogram_bin_edges(milliseconds, bins=40, range=(0.0, float(np.percentile(milliseconds, 99.5)) or 1.0))
    counts, _ = np.histogram(np.minimum(milliseconds, edges[-1]), edges)
    median, p99 = np.percentile(milliseconds, [50, 99])
    title = f"Time in the tracker: median {median:.1f} ms a frame, 99 % within {p99:.1f} ms"
    return Chart(title, "ms", "frames", [Series("frames", edges.tolist(), counts.tolist())], bars=True)


SHORT = 3  # moments; a track of fewer
UNSEEN = 0.15  # s since the last detection, from which a track coasts
COLUMNS = (
    *("class", "tracks", "short", "boxes", "life, s", "unseen", "gaps", "speed, m/s", "position ±, m"),
    *("score",),
)
TITLE = (
    f"Tracks; short: fewer than {SHORT} moments; life, speed, deviation and score: medians; unseen: share of boxes "
    "without a detection; gaps: times that a track was lost from view and seen again"
)


@dataclass(frozen=True, eq=False)
class _TrackSpans(Columns):
    """T tracks as wholes: their class, s from first to last box, boxes, and gaps, (T,)."""

    label: StrArray
    seconds: FloatArray
    boxes: FloatArray
    gaps: FloatArray


@dataclass(frozen=True, eq=False)
class _Boxes(Columns):
    """N boxes: their class, speed (m/s), deviation of the position (m), score, and whether they are unseen, (N,)."""

    label: StrArray
    speed: FloatArray
    deviation: FloatArray
    score: FloatArray
    unseen: FloatArray


Table = TypeVar("Table", _TrackSpans, _Boxes)


def _of_class(table: Table, label: str) -> Table:
    return table.select((table.label == label) | (label == "all"))


def track_figures(results: Sequence[SceneResult]) -> FigureTable:
    """Return a table with a row for each class."""
    lives, boxes = _track_spans(results), _boxes(results)
    classes = np.unique(lives.label).tolist()
    rows = [
        _row(name, _of_class(lives, name), _of_class(boxes, name))
        for name in (["all"] if len(classes) > 1 else []) + classes
    ]
    return FigureTable(TITLE, COLUMNS, tuple(rows))


def track_charts(results: Sequence[SceneResult]) -> list[Chart]:
    """Return the number of tracks over time, and distributions of lives, speeds and scores by class."""
    lives, boxes = _track_spans(results), _boxes(results)
    classes = np.unique(lives.label).tolist()
    charts = [
        distribution(
            "Life of tracks", "s", "share of tracks below", [(c, _of_class(lives, c).seconds) for c in classes]
        ),
        distribution("Speed", "m/s", "share of boxes below", [(c, _known(_of_class(boxes, c).speed)) for c in classes]),
        distribution(
            "Score", "score", "share of boxes below", [(c, _known(_of_class(boxes, c).score)) for c in classes]
        ),
    ]
    return [_counts(results), *(chart for chart in charts if chart.series)]


def _counts(results: Sequence[SceneResult]) -> Chart:
    series = []
    for each in results[:8]:
        counts = np.bincount(each.found.frame, minlength=len(each.scene))
        times = each.scene.timestamps - each.scene.timestamps[:1]
        series.append(Series(each.scene.name, times.tolist(), counts.tolist()))
    return Chart("Tracks at a time", "s", "tracks", series)


def _row(name: str, lives: _TrackSpans, boxes: _Boxes) -> tuple[str, ...]:
    known = np.isfinite(boxes.unseen)
    return (
        name,
        cell(len(lives.label)),
        cell(int((lives.boxes < SHORT).sum())),
        cell(len(boxes.label)),
        cell(_median(lives.seconds)),
        cell(float(boxes.unseen[known].mean()) if known.any() else float("nan")),
        cell(int(lives.gaps.sum())) if known.any() else cell(float("nan")),
        *(cell(_median(column)) for column in (boxes.speed, boxes.deviation, boxes.score)),
    )


def _known(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]


def _median(values: FloatArray) -> float:
    known = _known(values)
    return float(np.median(known)) if len(known) else float("nan")


def _unseen(result: SceneResult) -> FloatArray:
    """Return (N,) 1 for a box that coasts, 0 for one that was detected, NaN where it is not known."""
    if result.coasting is None:
        return np.full(len(result.found), np.nan)
    return np.where(np.isnan(result.coasting), np.nan, result.coasting > UNSEEN)


def _boxes(results: Sequence[SceneResult]) -> _Boxes:
    none = _Boxes(np.empty(0, dtype="<U1"), *(np.empty(0),) * 4)
    return _Boxes.concatenate([none, *map(_scene_boxes, results)])


def _scene_boxes(result: SceneResult) -> _Boxes:
    found = result.found
    deviation = np.sqrt(np.trace(found.position_covariance, axis1=1, axis2=2) / 2)
    speed = np.linalg.norm(found.boxes.velocity, axis=1)
    return _Boxes(found.boxes.label, speed, deviation, found.score, _unseen(result))


def _track_spans(results: Sequence[SceneResult]) -> _TrackSpans:
    none = _TrackSpans(np.empty(0, dtype="<U1"), *(np.empty(0),) * 3)
    return _TrackSpans.concatenate([none, *map(_scene_spans, results)])


def _scene_spans(result: SceneResult) -> _TrackSpans:
    table, unseen = result.found, np.nan_to_num(_unseen(result))
    ids, first, number, count = np.unique(table.id, return_index=True, return_inverse=True, return_counts=True)
    time = result.scene.timestamps[table.frame]
    order = np.lexsort((table.frame, number))
    ends = np.cumsum(count)
    seconds = time[order][ends - 1] - time[order][ends - count]
    again = (unseen[order][:-1] == 1) & (unseen[order][1:] == 0) & (number[order][:-1] == number[order][1:])
    gaps = np.bincount(number[order][1:][again], minlength=len(ids))
    return _TrackSpans(table.boxes.label[first], seconds, count.astype(np.float64), gaps.astype(np.float64))


REACH = 2.0  # m between the centres of a track and a detection of its class


def unseen_for(table: SceneBoxes, times: FloatArray, detections: Sequence[Boxes]) -> FloatArray:
    """Return (N,) s since a detection of the class was near a track; 0 at its first box.

    times (K,), s, and detections of the K moments
    """
    last: dict[str, float] = {}
    unseen = [np.empty(0)]
    for time, found, boxes in zip(times.tolist(), table.by_frame(len(times)), detections, strict=True):
        gap = np.linalg.norm(found.boxes.position[:, None, :2] - boxes.position[:, :2], axis=2)
        near = ((gap < REACH) & (found.boxes.label[:, None] == boxes.label)).any(axis=1)
        ids = found.id.tolist()
        last |= {id_: time for id_, seen in zip(ids, near.tolist(), strict=True) if seen or id_ not in last}
        unseen.append(np.array([time - last[id_] for id_ in ids]))
    return np.concatenate(unseen)
