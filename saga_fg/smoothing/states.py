"""Objects over the moments of a recording: states, edges, and labels of each moment.

Edges of a recording: the tracker's rules at smoothed estimates, which use its future too.

An online edge depends on the estimates of its time; offline the same rules get smoothed positions, and whether an
object ever moves.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np

from saga_fg.model import EdgeRule, NodeTable, NodeType, SceneGraph, build_graph
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray
from saga_fg.tables import PROBABILITIES
from saga_fg.types import Tracks


@dataclass(frozen=True, eq=False)
class Lifespans(Columns):
    """n objects: id (n,) unique and ascending, label (n,) classes, first and last (n,) moments, both included."""

    id: IntArray
    label: StrArray
    first: IntArray
    last: IntArray

    def rows_of(self, ids: IntArray) -> IntArray:
        """The rows of some objects that are all there."""
        return np.searchsorted(self.id, ids)

    def reaching(self, times: FloatArray, back: float, ahead: float) -> Self:
        """Extend to up to `back` s earlier and `ahead` s later; times (K,) s, of all moments."""
        first = np.searchsorted(times, times[self.first] - back)
        last = np.searchsorted(times, times[self.last] + ahead, side="right") - 1
        return replace(self, first=np.minimum(first, self.first), last=np.maximum(last, self.last))


def lifespans_of(object_of: IntArray, label: StrArray, moment: IntArray) -> Lifespans:
    """The lifespans of all objects from their first to their last detection.

    object_of (N,) the object of each detection, negative for none; label (N,), moment (N,) of the detections
    """
    rows = np.flatnonzero(object_of >= 0)
    ids, index = np.unique(object_of[rows], return_inverse=True)
    first = np.full(len(ids), np.iinfo(np.int64).max)
    last = np.full(len(ids), -1)
    np.minimum.at(first, index, moment[rows])
    np.maximum.at(last, index, moment[rows])
    example = np.zeros(len(ids), dtype=np.int64)
    example[index] = rows
    return Lifespans(ids, label[example] if len(ids) else np.empty(0, dtype="<U1"), first, last)


@dataclass(frozen=True, eq=False)
class StateTable(Columns):
    """Smoothed states, R rows in order of moments and within a moment of ids.

    moment, id (R,); mean (R, 4) local position (m) and velocity (m/s); covariance (R, 4, 4)
    """

    moment: IntArray
    id: IntArray
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def of_moments(cls, parts: Sequence[tuple[int, IntArray, FloatArray, FloatArray]]) -> Self:
        """Build from (moment, ids, means, covariances) of each moment in order."""
        if not parts:
            return cls(*(np.empty(0, dtype=np.int64),) * 2, np.empty((0, 4)), np.empty((0, 4, 4)))
        moment = np.repeat([k for k, *_ in parts], [len(ids) for _, ids, *_ in parts])
        ids, mean, P = (np.concatenate([part[i] for part in parts]) for i in (1, 2, 3))
        order = np.lexsort((ids, moment))
        return cls(moment[order], ids[order], mean[order], P[order])

    def merged(self, other: Self) -> Self:
        """With the states of other objects."""
        both = self.append(other)
        return both.select(np.lexsort((both.id, both.moment)))

    def within(self, lifespans: Lifespans) -> Self:
        """The states of some objects from their first to their last moment."""
        row = np.minimum(lifespans.rows_of(self.id), max(len(lifespans) - 1, 0))
        if len(lifespans) == 0:
            return self.select(np.empty(0, dtype=np.int64))
        there = (
            (lifespans.id[row] == self.id)
            & (lifespans.first[row] <= self.moment)
            & (self.moment <= lifespans.last[row])
        )
        return self.select(there)

    @cached_property
    def previous(self) -> IntArray:
        """(R,) the row of the same object at the moment before, -1 for its first."""
        order = np.lexsort((self.moment, self.id))
        before = np.full(len(self), -1, dtype=np.int64)
        same = self.id[order[1:]] == self.id[order[:-1]]
        before[order[1:][same]] = order[:-1][same]
        return before

    def elapsed(self, times: FloatArray) -> FloatArray:
        """(R,) s from the object's state before to each state, 0 for its first; times (K,) s, of all moments."""
        return np.where(self.previous >= 0, times[self.moment] - times[self.moment[self.previous]], 0.0)

    @cached_property
    def _bounds(self) -> IntArray:
        return np.searchsorted(self.moment, np.arange((int(self.moment[-1]) if len(self) else 0) + 2))

    def at(self, moment: int) -> slice:
        """The rows of a moment."""
        if moment + 1 >= len(self._bounds):
            return slice(len(self), len(self))
        return slice(int(self._bounds[moment]), int(self._bounds[moment + 1]))

    def rows_of(self, moment: IntArray, ids: IntArray) -> IntArray:
        """(m,) the rows of these objects at these moments, -1 where there is none."""
        if len(self) == 0:
            return np.full(len(ids), -1, dtype=np.int64)
        wanted = moment * self._span + ids
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self) - 1)
        return np.where((self._keys[at] == wanted) & (ids >= 0) & (ids < self._span), at, -1)

    @cached_property
    def _span(self) -> int:
        return int(self.id.max()) + 1

    @cached_property
    def _keys(self) -> IntArray:
        """(R,) one ascending number for each moment and object."""
        return self.moment * self._span + self.id


Source = Literal["observed", "filled", "extended", "corrected", "near"]
"""Observed: the object was detected; filled: between detections; extended: before its online track or after it;
corrected: a person said so; near: within a second of such a box."""

Quality = Literal["high", "medium", "low"]
MEDIUM_SCORE = 0.2  # least score of a box of medium quality
HIGH_SCORE = 0.5  # least score of a box of high quality
HIGH_DEVIATION = 0.3  # largest standard deviation of the position of a box of high quality, m
MEDIUM_DEVIATION = 0.8  # likewise of a box of medium quality, m


@dataclass(frozen=True, eq=False)
class Probabilities(Columns):
    """Probabilities (N,) of labels or objects: that the object exists, that its class is right, that it is one object
    all along, and that its heading is not turned round."""

    exists: FloatArray
    label: FloatArray
    one: FloatArray
    heading: FloatArray

    def table_columns(self) -> dict[str, FloatArray]:
        """The columns (N,) of a table, by name."""
        columns = (self.exists, self.label, self.one, self.heading)
        return {name: np.round(p, 4) for name, p in zip(PROBABILITIES, columns, strict=True)}


@dataclass(frozen=True, eq=False)
class Labels:
    """The boxes of one moment.

    tracks    boxes (world), ids, scores and covariances; `coasting` is the time to the nearest detection, s
    yaw_variance (N,)  of the heading, rad^2; NaN where unknown
    source    (N,) observed, filled, extended, corrected or near
    quality   (N,) high, medium or low
    probability  that the labels are right
    """

    tracks: Tracks
    yaw_variance: FloatArray
    source: StrArray
    quality: StrArray
    probability: Probabilities

    @classmethod
    def empty(cls) -> Self:
        """No labels."""
        none, words = np.empty(0), np.empty(0, dtype=np.str_)
        return cls(Tracks.empty(0.0), none, words, words, Probabilities(none, none, none, none))

    def __len__(self) -> int:
        return len(self.tracks)

    def table_columns(self) -> dict[str, Any]:
        """The columns (N,) of a table, by name."""
        own = {"yaw_variance": self.yaw_variance, "source": self.source, "quality": self.quality}
        return {**self.tracks.table_columns(), **own, **self.probability.table_columns()}


@dataclass(frozen=True)
class LabelCounts:
    """Numbers of boxes of a recording by `Source`, and dropped with their objects; of objects kept and dropped, and of
    tracklets stitched to another."""

    observed: int = 0
    filled: int = 0
    extended: int = 0
    corrected: int = 0
    near: int = 0
    dropped: int = 0
    objects: int = 0
    dropped_objects: int = 0
    joined: int = 0

    @property
    def boxes(self) -> int:
        """Boxes written."""
        return self.observed + self.filled + self.extended + self.corrected + self.near

    @classmethod
    def sum(cls, counts: Iterable[LabelCounts]) -> Self:
        """Add up several recordings."""
        parts = list(counts)
        return cls(*(sum(getattr(part, name) for part in parts) for name in cls.__dataclass_fields__))


def quality_of(score: FloatArray, covariance: FloatArray) -> StrArray:
    """(N,) the quality of boxes with these scores (N,) and position covariances (N, 2, 2), m^2."""
    deviation = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]) if len(score) else np.empty(0)
    high = (score >= HIGH_SCORE) & (deviation <= HIGH_DEVIATION)
    medium = (score >= MEDIUM_SCORE) & (deviation <= MEDIUM_DEVIATION)
    return np.where(high, "high", np.where(medium, "medium", "low"))


MOVING = 2.0  # speed that is no estimation error, m/s
FACING = 1.0  # speed from which an object heads where it moves, m/s


@dataclass(frozen=True, eq=False)
class SmoothedEdges:
    """Graphs by edge rules at smoothed states; called with a moment, the ids of the objects there and their types.

    yaw (n,) and length (n,) of the objects by their detections, NaN where unknown
    """

    rules: Sequence[EdgeRule]
    explained_noise: float
    lifespans: Lifespans
    states: StateTable
    yaw: FloatArray
    length: FloatArray

    @cached_property
    def has_moved(self) -> BoolArray:
        """(n,) which objects are ever clearly in motion."""
        speed = np.hypot(*self.states.mean[:, 2:].T)
        sigma = np.sqrt(np.trace(self.states.covariance[:, 2:, 2:], axis1=1, axis2=2) / 2)
        moving = self.states.id[(speed > MOVING) & (speed > 3 * sigma)]
        return np.isin(self.lifespans.id, moving)

    def __call__(self, moment: int, ids: IntArray, types: tuple[NodeType, ...]) -> SceneGraph:
        at = self.states.rows_of(np.full(len(ids), moment), ids)
        rows, objects = np.flatnonzero(at >= 0), self.lifespans.rows_of(ids)
        mean, P = self.states.mean[at[rows]], self.states.covariance[at[rows]]
        velocity = mean[:, 2:]
        course = np.arctan2(velocity[:, 1], velocity[:, 0])
        known = np.isfinite(self.yaw[objects[rows]]) & (np.hypot(*velocity.T) < FACING)
        nodes = NodeTable(
            id=ids[rows],
            label=self.lifespans.label[objects[rows]],
            types=tuple(types[row] for row in rows.tolist()),
            position=mean[:, :2],
            velocity=velocity,
            heading=np.where(known, self.yaw[objects[rows]], course),
            length=np.nan_to_num(self.length[objects[rows]]),
            velocity_variance=np.trace(P[:, 2:, 2:], axis1=1, axis2=2) / 2,
            has_moved=self.has_moved[objects[rows]],
        )
        graph = build_graph(nodes, self.rules, explained_noise=self.explained_noise)
        if len(rows) == len(ids):
            return graph
        missing = np.setdiff1d(np.arange(len(ids)), rows)  # objects the states do not know move on their own
        return SceneGraph(
            np.concatenate([graph.nodes, ids[missing]]),
            (*graph.types, *(types[row] for row in missing.tolist())),
            graph.edges,
            np.concatenate([graph.diffusion_scale, np.ones(len(missing))]),
            graph.nonlinear,
        )
