"""Objects of recordings that are hidden for some seconds, predicted while the tracks around them go on.

A tracker without edges goes through a recording. Each of its tracks that holds a labelled object begins a gap at many
moments: from there on its object is hidden, and the track is predicted by the tracker's own step
(`saga_fg.tracking.prediction`), with the motion, the turn, the stationarity and the edges of the configuration. At the
beginning of each step the tracks around it are set to what the tracker knew of them then. So they are taken as known:
the hidden track depends on them, and not the other way round. All gaps are predicted side by side, as one large scene
in which they are kilometres apart.

Marginals of nodes whose correlations are left out, under a transition of the scene graph.

    m_i <- sum_j F_ij m_j + b_i        P_i <- sum_j F_ij P_j F_ij^T + Q_i

For nodes whose sources are known, such as tracks that go on beside a hidden one: there the correlation of a target with
its sources is lost anyway as soon as they are measured again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError
from saga_fg.model import AccelerationLaw, EdgeRule, Interaction, Mixture, NodeTable, Pairs, Sensor, Transition
from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, assign
from saga_fg.tracking import (
    MOVING,
    JointTrackState,
    Kinematics,
    Passages,
    SensorEvidence,
    Tracker,
    TrackerSettings,
    TrackerState,
    TrackTable,
    Traffic,
    TrafficSettings,
    motion_of,
    predict_state,
)
from saga_fg.types import LabelledObjects, Scene


class Marginals:
    """n nodes with the ids 0 to n - 1, and as much of an `Estimator` as a tracker's prediction asks for.

    means (n, D), covariances (n, D, D): padded to the largest state
    wanted  the first so many are predicted, the others stay
    """

    time = 0.0
    others = ()

    def __init__(self, means: FloatArray, covariances: FloatArray, wanted: int) -> None:
        self.means, self.covariances, self._wanted = means, covariances, wanted
        self.nodes = np.arange(len(means))

    def predict(self, transition: Transition) -> None:
        """Move the first nodes on by a transition over all."""
        m, P, n = self.means, self.covariances, self._wanted
        mean, covariance = m.copy(), P.copy()
        mean[:n], covariance[:n] = 0.0, 0.0
        for blocks in transition.F:
            mine = np.flatnonzero(blocks.target < n)
            t, s, F = blocks.target[mine], blocks.source[mine], blocks.values[mine]
            i, j = F.shape[1:]
            np.add.at(mean[:, :i], t, (F @ m[s, :j, None])[..., 0])
            np.add.at(covariance[:, :i, :i], t, F @ P[s, :j, :j] @ np.swapaxes(F, 1, 2))
        for blocks in transition.Q:
            mine = np.flatnonzero(blocks.target < n)
            t, d = blocks.target[mine], blocks.values.shape[1]
            covariance[t, :d, :d] += blocks.values[mine]
        dims, start = transition.graph.dims[:n], transition.offsets[:n]
        for d in np.unique(dims).tolist():
            rows = np.flatnonzero(dims == d)
            mean[rows, :d] += transition.b[start[rows][:, None] + np.arange(d)]
        self.means, self.covariances = mean, covariance
        self.time += transition.dt

    def mean(self, nodes: ArrayLike) -> FloatArray:
        """(k, D) means, padded."""
        return np.asarray(self.means[np.asarray(nodes)])

    def covariance(self, nodes: ArrayLike) -> FloatArray:
        """(k, D, D) covariances, padded."""
        return np.asarray(self.covariances[np.asarray(nodes)])

    def planar_marginals(self, nodes: ArrayLike, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (k, 4) with their covariances (k, 4, 4); places (k, 4) in the states, -1: zeros."""
        rows, known = np.arange(len(places))[:, None], places >= 0
        mean = np.where(known, self.mean(nodes)[rows, places], 0.0)
        covariance = self.covariance(nodes)[rows[:, :, None], places[:, :, None], places[:, None, :]]
        return mean, np.where(known[:, :, None] & known[:, None, :], covariance, 0.0)


GATE = 2.0  # m, from a track to its object


@dataclass(eq=False)
class RecordedTracks(Columns):
    """n tracks at some moments of a recording, as the tracker had them.

    table         their rows; without the evidence of sensors, with times counted from the moment
    mean, P       (n, D), (n, D, D) of their states, padded to the largest
    """

    table: TrackTable
    mean: FloatArray
    P: FloatArray


def recorded_tracks(
    scene: Scene, settings: TrackerSettings, sensors: Mapping[str, Sensor], labels: LabelledObjects
) -> tuple[list[RecordedTracks], FloatArray, list[IntArray]]:
    """The tracks after each frame, in world coordinates; the times of the frames; the object of each track, -1: none.

    Only tracks that were just detected hold an object.
    """
    settings = replace(settings, edges=(), providers=(), estimator="kalman")
    tracker = Tracker(settings, sensors)
    state = TrackerState(settings, ())
    parts, times, held = [], [], []
    for frame in scene.frames:
        tracker.step(frame)
        if tracker.time_verdict == "late":
            continue
        state.restore(tracker.snapshot())
        table, time = state.table, state.start + state.time
        if len(table) == 0:
            continue
        kinds = state.joint.rows_by_type(table.label)
        D = max(kind.dim for kind, _ in kinds)
        mean, P = np.zeros((len(table), max(D, 6))), np.zeros((len(table), max(D, 6), max(D, 6)))
        for kind, rows in kinds:
            mean[rows, : kind.dim] = state.joint.estimator.mean(table.id[rows])
            P[rows, : kind.dim, : kind.dim] = state.joint.estimator.covariance(table.id[rows])
        position = mean[:, :2] + state.origin
        truth = labels.at(time)
        apart = np.hypot(*np.moveaxis(position[:, None] - truth[None], -1, 0))
        fresh = table.last_detected >= state.time - 1e-6
        possible = fresh[:, None] & (table.label[:, None] == labels.label) & (np.nan_to_num(apart, nan=np.inf) < GATE)
        row, column = assign(np.nan_to_num(apart, nan=1e9), possible, unmatched=GATE)
        owner = np.full(len(table), -1)
        owner[row] = column
        mean[:, :2] = position
        table.stationarity.position = table.stationarity.position + state.origin
        for name in ("initiated", "last_detected"):
            setattr(table, name, getattr(table, name) - state.time)
        table.sensors = SensorEvidence.empty(len(table))
        parts.append(RecordedTracks(table, mean, P))
        times.append(time)
        held.append(owner)
    return parts, np.array(times), held


APART = 5000.0  # m between gaps: no edge reaches as far
LATER = 1e9  # s between recordings: no trail is remembered for as long
LARGEST_ID = 10**9  # of tracks
LONGEST = 5.0  # s: length of the longest gap
STEP = 0.5  # s between the steps of a gap
FOLLOWED = 1.5  # s for which an object is tracked before its gap
SPACING = 1.0  # s between the starts of an object's gaps
NEIGHBOURS, REACH = 24, 60.0  # most tracks around a hidden one that are kept, and their largest distance, m


class _Onto(NamedTuple):
    """A rule with its edges into the first `wanted` nodes alone."""

    rule: EdgeRule
    wanted: int

    @property
    def interaction(self) -> Interaction | AccelerationLaw:
        return self.rule.interaction

    def pairs(self, nodes: NodeTable) -> Pairs:
        """The edges into the first nodes."""
        pairs = self.rule.pairs(replace(nodes, acted=np.arange(len(nodes)) < self.wanted))
        mine = pairs.target < self.wanted
        return Pairs(pairs.target[mine], pairs.source[mine], pairs.rate[mine])


class GapPrediction(NamedTuple):
    """Predictions of W hidden objects at the ends of S steps, NaN after an object's last known place.

    position  (W, S, 2), m
    P         (W, S, 2, 2) covariance of the position, m^2
    """

    position: FloatArray
    P: FloatArray


class _Shared(NamedTuple):
    """Shared by all gaps: the tracks of the recordings, and the trails that the tracks leave."""

    tracks: RecordedTracks
    trails: Passages


@dataclass(frozen=True, eq=False)
class HiddenObjects(Columns):
    """W gaps of S steps, each with at most M tracks around.

    start       (W,) row of the hidden track in `recorded`; time (W,), s; label (W,) of the object
    neighbours  (W, S, M) rows when a step starts, -1: none; lag (W, S), s, from their moment to the start of the step
    place       (W, S, 2) of the object at the end of each step, NaN where unknown
    recorded    the tracks of the recordings, and the trails
    """

    start: IntArray
    time: FloatArray
    label: StrArray
    neighbours: IntArray
    lag: FloatArray
    place: FloatArray
    recorded: _Shared

    @property
    def known(self) -> BoolArray:
        """(W, S) whether the place is known."""
        return np.asarray(np.isfinite(self.place[..., 0]))

    def sampled(self, most: int, seed: int) -> Self:
        """At most `most` of the gaps, chosen at random."""
        chosen = np.random.default_rng(seed).choice(len(self), min(most, len(self)), replace=False)
        return self.select(np.sort(chosen))

    @classmethod
    def pooled(cls, parts: Sequence[HiddenObjects]) -> HiddenObjects:
        """The gaps of several recordings."""
        recorded = RecordedTracks.concatenate([part.recorded.tracks for part in parts])
        first = np.cumsum([0, *(len(part.recorded.tracks.mean) for part in parts)])
        after = LATER * np.arange(len(parts))
        points = [part.recorded.trails for part in parts]
        trails = Passages.concatenate([replace(own, time=own.time + t) for own, t in zip(points, after, strict=True)])
        moved = [
            replace(
                part,
                start=part.start + n,
                time=part.time + t,
                neighbours=np.where(part.neighbours >= 0, part.neighbours + n, -1),
                recorded=_Shared(recorded, trails),
            )
            for part, n, t in zip(parts, first, after, strict=False)
        ]
        return cls.concatenate(moved)

    def predict(self, settings: TrackerSettings, rules: Sequence[EdgeRule]) -> GapPrediction:
        """Predict all hidden tracks by a tracker's settings and these rules.

        Raises `InputError` for classes that move nonlinearly or by a mixture, and for rules that act on accelerations
        nonlinearly.
        """
        mixed = any(isinstance(one.motion, Mixture) for one in settings.classes.values())
        if mixed or settings.nonlinear(rules):
            raise InputError("expected linear motions and interactions to learn with, got nonlinear ones or mixtures")
        W, S = self.place.shape[:2]
        found = GapPrediction(np.full((W, S, 2), np.nan), np.full((W, S, 2, 2), np.nan))
        last = S - self.known[:, ::-1].argmax(axis=1)
        order = np.argsort(np.where(self.known.any(axis=1), -last, 1), kind="stable")
        active = [int((last[self.known.any(axis=1)] > s).sum()) for s in range(S)]
        recorded = self.recorded.tracks
        side = int(np.ceil(np.sqrt(max(W, 1))))
        shift = APART * np.stack(np.divmod(np.arange(W), side), axis=1) - recorded.mean[self.start, :2]
        hidden = _placed(recorded.select(self.start[order]), np.arange(W), shift[order], 0.0)
        state = TrackerState(settings, ())
        trails = self._trails(settings.traffic, shift[order], order)
        state.traffic.left, state.traffic.latest = trails, trails.select(slice(0, 0))
        for s in range(S):
            n = active[s]
            if n == 0:
                break
            hidden, rows = hidden.select(slice(0, n)), order[:n]
            parts = [hidden]
            if rules:
                gap, column = np.nonzero(self.neighbours[rows, s] >= 0)
                around = recorded.select(self.neighbours[rows[gap], s, column])
                around.mean[:, :2] += around.mean[:, 2:4] * self.lag[rows[gap], s, None]
                ids = n + np.arange(len(gap))
                parts.append(_placed(around, ids, shift[rows[gap]], s * STEP))
            scene = RecordedTracks.concatenate(parts)
            marginals: Any = Marginals(scene.mean, scene.P, wanted=n)
            state.rules = tuple(_Onto(rule, n) for rule in rules)
            state.time, state.table = s * STEP, scene.table
            state.joint = JointTrackState(marginals, partial(motion_of, settings))
            predict_state(state, (s + 1) * STEP)
            now = state.reported_kinematics()
            found.position[rows, s], found.P[rows, s] = now.position[:n] - shift[rows], now.P[:n]
            hidden = RecordedTracks(state.table.select(slice(0, n)), marginals.means[:n], marginals.covariances[:n])
        return found

    def _trails(self, settings: TrafficSettings, shift: FloatArray, order: IntArray) -> Passages:
        """The trails that the gaps `order` (W,) begin with, each shifted (W, 2) to its place."""
        points, parts, memory = self.recorded.trails, [], settings.memory if settings.reach > 0 else 0.0
        own, place = self.recorded.tracks.table.id[self.start], self.recorded.tracks.mean[self.start, :2]
        for k, row in enumerate(order.tolist() if memory > 0 else ()):
            lately = slice(*np.searchsorted(points.time, [self.time[row] - memory, self.time[row] + 1e-6]))
            found = points.select(lately)
            near = np.abs(found.position - place[row]).max(axis=1, initial=0.0) < APART / 4
            found = found.select(near & (found.id != own[row]))
            ids, position = found.id + (k + 1) * LARGEST_ID, found.position + shift[k]
            parts.append(replace(found, id=ids, position=position, time=found.time - self.time[row]))
        return Passages.concatenate(parts) if parts else points.select(slice(0, 0))


def _placed(tracks: RecordedTracks, ids: IntArray, shift: FloatArray, time: float) -> RecordedTracks:
    """Rows with other ids, shifted, their times counted from `time` before."""
    table = tracks.table
    table.id = ids
    table.stationarity.position = table.stationarity.position + shift
    for name in ("initiated", "last_detected"):
        setattr(table, name, getattr(table, name) + time)
    mean = tracks.mean.copy()
    mean[:, :2] += shift
    return RecordedTracks(table, mean, tracks.P)


def hidden_objects(
    scene: Scene,
    tracker: TrackerSettings,
    sensors: Mapping[str, Sensor],
    longest: float = LONGEST,
) -> HiddenObjects | None:
    """All gaps of the labelled objects of a scene that a tracker without edges follows; None where there are none.

    longest  of the gaps, s. Raises `InputError` for a scene without ground truth.
    """
    labels = LabelledObjects.from_scene(scene)
    parts, moments, held = recorded_tracks(scene, tracker, sensors, labels)
    if not parts:
        return None
    recorded = RecordedTracks.concatenate(parts)
    first = np.cumsum([0, *map(len, (part.mean for part in parts))])
    steps = max(1, round(longest / STEP))
    starts, latest = [], -np.inf
    for k, time in enumerate(moments):
        if time - latest >= SPACING - 1e-6:
            latest = time
            starts.append(k)
    columns: list[tuple[IntArray, FloatArray, StrArray, IntArray, FloatArray, FloatArray]] = []
    for k in starts:
        times = moments[k] + STEP * np.arange(steps + 1)
        followed = -parts[k].table.initiated >= FOLLOWED - 1e-6
        rows = np.flatnonzero((held[k] >= 0) & followed)
        place = np.stack([labels.at(t)[held[k][rows]] for t in times[1:]], axis=1)
        rows, place = rows[np.isfinite(place[..., 0]).any(axis=1)], place[np.isfinite(place[..., 0]).any(axis=1)]
        near, lag = np.full((len(rows), steps, NEIGHBOURS), -1), np.zeros((len(rows), steps))
        for s in range(steps):
            m = int(np.argmin(np.abs(moments - times[s])))
            if abs(moments[m] - times[s]) > STEP:
                continue
            lag[:, s] = times[s] - moments[m]
            expected = parts[k].mean[rows, :2] + parts[k].mean[rows, 2:4] * (times[s] - times[0])
            apart = np.hypot(*np.moveaxis(parts[m].mean[None, :, :2] - expected[:, None], -1, 0))
            same = parts[m].table.id[None] == parts[k].table.id[rows][:, None]
            apart[same | (apart > REACH)] = np.inf
            nearest = np.argsort(apart, axis=1)[:, :NEIGHBOURS]
            there = np.isfinite(np.take_along_axis(apart, nearest, axis=1))
            near[:, s, : nearest.shape[1]] = np.where(there, first[m] + nearest, -1)
        time = np.full(len(rows), moments[k])
        columns.append((first[k] + rows, time, parts[k].table.label[rows], near, lag, place))
    start, begin, label, near, lag, place = (np.concatenate(column) for column in zip(*columns, strict=True))
    shared = _Shared(recorded, _trails(parts, moments))
    found = HiddenObjects(start, begin, label, near, lag, place, shared)
    return found if len(found) else None


def _trails(parts: Sequence[RecordedTracks], moments: FloatArray) -> Passages:
    """The trails of all tracks at their moments, by time."""
    traffic = Traffic(TrafficSettings(memory=LATER))
    for part, time in zip(parts, moments, strict=True):
        now = Kinematics(part.mean[:, :2], part.mean[:, 2:4], part.P[:, :2, :2], part.P[:, 2:4, 2:4])
        moves = (part.table.last_detected >= -1e-6) & (np.hypot(*now.velocity.T) > MOVING)
        found = Passages.from_tracks(part.table.id, part.table.label, now, part.table.box.yaw, moves, float(time))
        traffic.update(found.select(found.moves), float(time))
    return traffic.left
