"""The labels of a whole recording, each with what is known of its object, and the objects by what a look is worth."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from saga_fg.numerics import FloatArray, IntArray, wrap_angle
from saga_fg.smoothing.boxes import is_reversed
from saga_fg.smoothing.doubt import LEAST_GAIN, REASONS, Review, far_off, gain_parts, object_probabilities
from saga_fg.smoothing.labelling import LabelColumns, LabelledStates, ObjectSummary, median_sizes, source_counts
from saga_fg.smoothing.states import LabelCounts, Labels, Probabilities


class LabelParts(Protocol):
    """Where the labels of a recording wait, chunk by chunk, as named arrays: a list, or files."""

    def append(self, part: Mapping[str, Any], /) -> None:
        """Add a chunk."""
        ...

    def __iter__(self) -> Iterator[Mapping[str, Any]]: ...


class RecordingLabels:
    """The labels of a recording, added chunk by chunk, and read back when it is over: iterating gives those of each
    chunk, one table a moment."""

    def __init__(self, parts: LabelParts) -> None:
        self._parts = parts
        self._id = np.empty(0, dtype=np.int64)  # of all objects, ascending; then their attributes
        self._size, self._score, self._agreement = np.empty((0, 3)), np.empty(0), np.empty(0)
        self._turned, self._gone = np.empty((2, 0), dtype=np.bool_)
        self._label = np.empty(0, dtype="U64")
        self._boxes, self._weakest = np.empty(0, dtype=np.int64), np.empty((0, 2))
        self._probability = Probabilities(*(np.empty(0),) * 4)

    def add(
        self,
        wanted: FloatArray,
        at: IntArray,
        labelled: LabelledStates,
        names: Mapping[int, int],
        signs: Mapping[int, float],
    ) -> None:
        """Add the labels at the times `wanted` (M,), s, which are the moments `at` (M,) of the states.

        names: the final id of each object; signs: -1 where its headings are half a turn off those before, else 1
        """
        spans = [labelled.states.at(moment) for moment in at.tolist()]
        rows = np.concatenate([np.empty(0, dtype=np.int64), *(np.arange(span.start, span.stop) for span in spans)])
        ids = labelled.states.id[rows].tolist()
        columns = replace(labelled.columns.select(rows), id=np.array([names[id_] for id_ in ids], dtype=np.int64))
        self._parts.append(
            {
                "time": wanted,
                "bounds": np.cumsum([0, *(span.stop - span.start for span in spans)]),
                "reversed": np.array([signs[id_] < 0 for id_ in ids], dtype=np.bool_),
                **vars(columns),
            }
        )

    def finish(self, summaries: Mapping[int, ObjectSummary], prior: float) -> None:
        """Take the final attributes of all objects.

        prior: opportunities without a detection that every object starts with
        """
        found = [summaries[id_] for id_ in sorted(summaries)]
        self._id, self._size = np.array(sorted(summaries), dtype=np.int64), median_sizes(found)

        def column(name: str) -> FloatArray:
            return np.array([getattr(each, name) for each in found], dtype=np.float64)

        weight, detections, votes = column("probability"), column("detections"), column("votes")
        self._score = weight / (np.maximum(column("opportunities"), detections) + prior)
        self._turned = is_reversed(column("path"), votes)
        self._agreement = np.abs(votes) / np.maximum(weight, 1e-9)
        self._boxes, rivals = column("boxes").astype(np.int64), column("rivals") / np.maximum(column("boxes"), 1)
        self._weakest = np.array([each.weakest for each in found]).reshape(len(found), 2)
        one, path = np.exp(column("log_one")), column("path")
        p = object_probabilities(self._score, detections, weight, rivals, path, votes, one)
        said = [each.said for each in found]
        real = np.array([each.exists is True for each in said], dtype=np.bool_)
        self._gone = np.array([each.exists is False for each in said], dtype=np.bool_)
        self._label = np.array([each.label for each in said], dtype="U64")
        self._score = np.where(real, 1.0, self._score)
        size = np.array([each.size for each in said]).reshape(-1, 3)
        self._size = np.where(np.isnan(size), self._size, size)
        self._probability = Probabilities(
            np.where(real, 1.0, p.exists), np.where(self._label != "", 1.0, p.label), p.one, p.heading
        )

    def counts(self) -> LabelCounts:
        """Where the boxes come from."""
        sources = [source_counts(columns.source) for _, _, _, columns in self._chunks()]
        return LabelCounts.sum(LabelCounts(**counts) for counts in sources)

    def __iter__(self) -> Iterator[tuple[Labels, ...]]:
        for times, rows, at, columns in self._chunks():
            size, score, doubt = self._size[at], self._score[at], self._probability.select(at)
            moments = zip(times.tolist(), rows, strict=True)
            yield tuple(
                columns.select(mine).labels(time, size[mine], score[mine], doubt.select(mine)) for time, mine in moments
            )

    def review(self, least_gain: float = LEAST_GAIN) -> Review:
        """The objects with a gain of `least_gain` at least, those first that are most worth a look."""
        n = len(self._id)
        off, worst, clearest = np.zeros(n), np.full((n, 4), -np.inf), np.full((n, 4), -np.inf)
        headed = np.zeros(n, dtype=np.int64)
        label = np.full(n, "", dtype="U64")
        place = np.full((n, 3), np.nan)  # time, x, y at the weakest step
        for times, rows, at, columns in self._chunks():
            time = np.repeat(times, [mine.stop - mine.start for mine in rows])
            P, speed = columns.position_covariance, np.hypot(*columns.velocity.T)
            known = self._size[at, 0], self._score[at], self._agreement[at]
            doubt = far_off(P, columns.yaw_variance, speed, *known)
            np.add.at(off, at, doubt)
            np.add.at(headed, at, np.isfinite(columns.yaw))
            label[at] = columns.label
            where = np.column_stack([time, columns.position[:, :2]])
            _keep_largest(worst, at, doubt, where)
            _keep_largest(clearest, at, -columns.coasting - np.trace(P, axis1=1, axis2=2), where)
            later = time >= self._weakest[at, 1]
            first = later & ~(place[at, 0] <= time)
            place[at[first][::-1]] = where[first][::-1]
        p = self._probability
        parts = gain_parts(p, self._boxes, headed, off)
        why = REASONS[np.argmax(parts, axis=1)]
        place = np.where(np.isnan(place), clearest[:, 1:], place)
        shown = np.select([why[:, None] == "box", why[:, None] == "identity"], [worst[:, 1:], place], clearest[:, 1:])
        gain = parts.sum(axis=1)
        found = Review(self._id, label, self._boxes, gain, why, shown[:, 0], shown[:, 1:], p, off)
        order = np.lexsort((self._id, -gain))
        return found.select(order[((self._boxes > 0) & ~self._gone & (gain >= least_gain))[order]])

    def _chunks(self) -> Iterator[tuple[FloatArray, list[slice], IntArray, LabelColumns]]:
        """Yield the times of a chunk's moments, s, their rows, the objects of all rows, and their columns."""
        for part in self._parts:
            stored = dict(part)
            times, bounds, backward = (stored.pop(name) for name in ("time", "bounds", "reversed"))
            at = np.searchsorted(self._id, stored["id"])
            turned = backward ^ self._turned[at]
            yaw = np.where(turned, wrap_angle(stored["yaw"] + np.pi), stored["yaw"])
            label = np.where(self._label[at] != "", self._label[at], stored["label"])
            kept = ~self._gone[at]
            columns = LabelColumns(**{**stored, "yaw": yaw, "label": label}).select(kept)
            bounds = np.concatenate([[0], np.cumsum(kept)])[bounds]
            yield times, [slice(a, b) for a, b in pairwise(bounds.tolist())], at[kept], columns


def _keep_largest(best: FloatArray, at: IntArray, value: FloatArray, where: FloatArray) -> None:
    """Put value and `where` (m, 3) into the rows `at` (m,) of `best` (n, 4) that have a smaller value."""
    order = np.argsort(value, kind="stable")
    better = order[value[order] > best[at[order], 0]]
    best[at[better]] = np.column_stack([value, where])[better]
