r"""Objects of recordings that are hidden for some seconds while the tracks around them go on, predicted by the tracker.

A tracker without edges goes through a recording. Each of its tracks that holds a labelled object begins a gap at many
moments: from there on its object is hidden, and the track is predicted by the tracker's own step
(`saga_fg.tracking.prediction`), with the motion, the turn, the stationarity and the edges of the configuration. At the
beginning of each step the tracks around it are set to what the tracker knew of them then. So they are taken as known:
the hidden track depends on them, and not the other way round. All gaps are predicted side by side, as one large scene
in which they are kilometres apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, Self

import numpy as np

from saga_fg.errors import InputError
from saga_fg.learning.marginals import Marginals
from saga_fg.model.edge_rules import EdgeRule, Pairs
from saga_fg.model.interactions import Interaction, NodeTable
from saga_fg.model.nonlinear_interactions import AccelerationLaw
from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.assignment import assign
from saga_fg.numerics.columns import Columns
from saga_fg.tracking import Tracker, TrackerSettings
from saga_fg.tracking.joint_state import JointTrackState
from saga_fg.tracking.map_nodes import motion_of
from saga_fg.tracking.prediction import predict
from saga_fg.tracking.sensor_evidence import SensorEvidence
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.dataset import Scene

APART = 5000.0  # m between gaps: no edge reaches as far
GATE = 2.0  # m, from a track to its object


@dataclass(frozen=True)
class GapSettings:
    """longest gap and time between its steps, s; how long an object is tracked before; how often gaps start, s;

    neighbours: at most so many, within `reach` m
    """

    longest: float = 5.0
    step: float = 0.5
    followed: float = 1.5
    spacing: float = 1.0
    neighbours: int = 8
    reach: float = 60.0


class _Onto(NamedTuple):
    """A rule with its edges into the first `wanted` nodes alone."""

    rule: EdgeRule
    wanted: int

    @property
    def interaction(self) -> Interaction | AccelerationLaw:
        return self.rule.interaction

    def pairs(self, nodes: NodeTable) -> Pairs:
        """The edges into the first nodes."""
        pairs = self.rule.pairs(nodes)
        mine = pairs.target < self.wanted
        return Pairs(pairs.target[mine], pairs.source[mine], pairs.rate[mine])


class GapPrediction(NamedTuple):
    """At the end of S steps: position (W, S, 2) and its covariance (W, S, 2, 2); NaN where nothing is to be compared"""

    position: FloatArray
    P: FloatArray


@dataclass(eq=False)
class RecordedTracks(Columns):
    """n tracks at some moments of a recording, as the tracker had them.

    table         their rows; without the evidence of sensors, with times counted from the moment
    mean, P       (n, D), (n, D, D) of their states, padded to the largest
    """

    table: TrackTable
    mean: FloatArray
    P: FloatArray


class _Shared(NamedTuple):
    """Shared by all gaps: the tracks of the recordings, and the step, s."""

    tracks: RecordedTracks
    step: float


@dataclass(frozen=True, eq=False)
class HiddenObjects(Columns):
    """W gaps of S steps, each with at most M tracks around.

    start       (W,) row of the hidden track in `recorded`; label (W,) of the object
    neighbours  (W, S, M) rows when a step starts, -1: none; lag (W, S), s, from their moment to the start of the step
    place       (W, S, 2) of the object at the end of each step, NaN where unknown
    recorded    the tracks of the recordings, and the step
    """

    start: IntArray
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
        if len(self) <= most:
            return self
        return self.select(np.sort(np.random.default_rng(seed).choice(len(self), most, replace=False)))

    @classmethod
    def pooled(cls, parts: Sequence[HiddenObjects]) -> HiddenObjects:
        """The gaps of several recordings."""
        recorded = RecordedTracks.concatenate([part.recorded.tracks for part in parts])
        first = np.cumsum([0, *(len(part.recorded.tracks.mean) for part in parts)])
        moved = [
            replace(
                part,
                start=part.start + n,
                neighbours=np.where(part.neighbours >= 0, part.neighbours + n, -1),
                recorded=_Shared(recorded, part.recorded.step),
            )
            for part, n in zip(parts, first, strict=False)
        ]
        return cls.concatenate(moved)

    def predict(self, settings: TrackerSettings, rules: Sequence[EdgeRule]) -> GapPrediction:
        """Predict all hidden tracks by a tracker's settings and these rules.

        Raises `InputError` for classes that move nonlinearly, and for rules that act on accelerations nonlinearly.
        """
        if settings.nonlinear(rules):
            raise InputError("expected linear motions and interactions to learn with, got nonlinear ones")
        W, S = self.place.shape[:2]
        found = GapPrediction(np.full((W, S, 2), np.nan), np.full((W, S, 2, 2), np.nan))
        last = S - self.known[:, ::-1].argmax(axis=1)
        order = np.argsort(np.where(self.known.any(axis=1), -last, 1), kind="stable")
        active = [int((last[self.known.any(axis=1)] > s).sum()) for s in range(S)]
        recorded, step = self.recorded
        side = int(np.ceil(np.sqrt(max(W, 1))))
        shift = APART * np.stack(np.divmod(np.arange(W), side), axis=1) - recorded.mean[self.start, :2]
        hidden = _placed(recorded.select(self.start[order]), np.arange(W), shift[order], 0.0)
        state = TrackerState(settings, ())
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
                parts.append(_placed(around, ids, shift[rows[gap]], s * step))
            scene = RecordedTracks.concatenate(parts)
            marginals = Marginals(scene.mean, scene.P, wanted=n)
            state.rules = tuple(_Onto(rule, n) for rule in rules)
            state.time, state.table = s * step, scene.table
            state.joint = JointTrackState(marginals, partial(motion_of, settings))
            predict(state, (s + 1) * step)
            now = state.reported_kinematics()
            found.position[rows, s], found.P[rows, s] = now.position[:n] - shift[rows], now.P[:n]
            hidden = RecordedTracks(state.table.select(slice(0, n)), marginals.means[:n], marginals.covariances[:n])
        return found


def _placed(tracks: RecordedTracks, ids: IntArray, shift: FloatArray, time: float) -> RecordedTracks:
    """Rows with other ids, shifted, their times counted from `time` before."""
    table = tracks.table
    table.id = ids
    table.stationarity.position = table.stationarity.position + shift
    for name in ("initiated", "last_detected", "last_in_view"):
        setattr(table, name, getattr(table, name) + time)
    mean = tracks.mean.copy()
    mean[:, :2] += shift
    return RecordedTracks(table, mean, tracks.P)


def hidden_objects(
    scene: Scene,
    tracker: TrackerSettings,
    sensors: Mapping[str, Sensor],
    settings: GapSettings | None = None,
) -> HiddenObjects | None:
    """All gaps of the labelled objects of a scene that a tracker without edges follows; None where there are none.

    Raises `InputError` for a scene without ground truth.
    """
    settings = settings or GapSettings()
    labels = _Labels.of(scene)
    parts, moments, held = _tracked(scene, tracker, sensors, labels)
    if not parts:
        return None
    recorded = RecordedTracks.concatenate(parts)
    first = np.cumsum([0, *map(len, (part.mean for part in parts))])
    steps = max(1, round(settings.longest / settings.step))
    starts, latest = [], -np.inf
    for k, time in enumerate(moments):
        if time - latest >= settings.spacing - 1e-6:
            latest = time
            starts.append(k)
    columns: list[tuple[IntArray, StrArray, IntArray, FloatArray, FloatArray]] = []
    for k in starts:
        times = moments[k] + settings.step * np.arange(steps + 1)
        followed = -parts[k].table.initiated >= settings.followed - 1e-6
        rows = np.flatnonzero((held[k] >= 0) & followed)
        place = np.stack([labels.at(t)[held[k][rows]] for t in times[1:]], axis=1)
        rows, place = rows[np.isfinite(place[..., 0]).any(axis=1)], place[np.isfinite(place[..., 0]).any(axis=1)]
        near, lag = np.full((len(rows), steps, settings.neighbours), -1), np.zeros((len(rows), steps))
        for s in range(steps):
            m = int(np.argmin(np.abs(moments - times[s])))
            if abs(moments[m] - times[s]) > settings.step:
                continue
            lag[:, s] = times[s] - moments[m]
            expected = parts[k].mean[rows, :2] + parts[k].mean[rows, 2:4] * (times[s] - times[0])
            apart = np.hypot(*np.moveaxis(parts[m].mean[None, :, :2] - expected[:, None], -1, 0))
            same = parts[m].table.id[None] == parts[k].table.id[rows][:, None]
            apart[same | (apart > settings.reach)] = np.inf
            nearest = np.argsort(apart, axis=1)[:, : settings.neighbours]
            there = np.isfinite(np.take_along_axis(apart, nearest, axis=1))
            near[:, s, : nearest.shape[1]] = np.where(there, first[m] + nearest, -1)
        columns.append((first[k] + rows, parts[k].table.label[rows], near, lag, place))
    start, label, near, lag, place = (np.concatenate(column) for column in zip(*columns, strict=True))
    found = HiddenObjects(start, label, near, lag, place, _Shared(recorded, settings.step))
    return found if len(found) else None


class _Labels(NamedTuple):
    """K labelled moments of N objects: time (K,), label (N,), position (K, N, 2), m, world, NaN where not labelled."""

    time: FloatArray
    label: StrArray
    position: FloatArray

    @classmethod
    def of(cls, scene: Scene) -> Self:
        if scene.ground_truth is None:
            raise InputError(f"scene {scene.name}: expected ground truth, there is none")
        names = np.unique(np.concatenate([moment.id for moment in scene.ground_truth]))
        position, label = np.full((len(scene), len(names), 2), np.nan), np.full(len(names), "", dtype="U64")
        for k, moment in enumerate(scene.ground_truth):
            rows = np.searchsorted(names, moment.id)
            position[k, rows], label[rows] = moment.boxes.position[:, :2], moment.boxes.label
        return cls(scene.timestamps, label, position)

    def at(self, time: float) -> FloatArray:
        """(N, 2) interpolated between the moments before and after; NaN beyond the recording."""
        k = int(np.searchsorted(self.time, time - 1e-6))
        if k == len(self.time) or (k == 0 and time < self.time[0] - 1e-6):
            return np.full(self.position.shape[1:], np.nan)
        if k == 0 or abs(self.time[k] - time) < 1e-6:
            return np.asarray(self.position[k])
        share = (self.time[k] - time) / (self.time[k] - self.time[k - 1])
        return np.asarray(share * self.position[k - 1] + (1 - share) * self.position[k])


def _tracked(
    scene: Scene, settings: TrackerSettings, sensors: Mapping[str, Sensor], labels: _Labels
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
        for name in ("initiated", "last_detected", "last_in_view"):
            setattr(table, name, getattr(table, name) - state.time)
        table.sensors = SensorEvidence.empty(len(table))
        parts.append(RecordedTracks(table, mean, P))
        times.append(time)
        held.append(owner)
    return parts, np.array(times), held
