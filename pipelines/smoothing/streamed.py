"""A recording smoothed as it is read, in memory that does not grow with its length.

    frames -> tracker, frame by frame -> stretches [a, b) smoothed within [a - margin, b + margin] -> labels, on disk

The tracker sees the recording once, from one end to the other. All rounds of smoothing (`pipelines.smoothing.rounds`)
are made anew for every stretch, with a margin to both sides beyond which nothing can be felt; what is given out are the
moments of the stretch alone. What is said of an object as a whole (size, score, front, identity) is gathered over the
stretches and put in at the end (`pipelines.smoothing.lifetimes`), when the labels are read back from disk. Memory is
that of a stretch with its margins, and a few numbers for every object that ever was.

A recording no longer than a stretch and a margin is one stretch: exactly what `smooth_scene` makes of it. Where it is
longer, stands are those that a stretch with its margins sees, and weak objects are dropped by their score in it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from pipelines.config import Method
from pipelines.smoothing.assembly import LabelledStates, dropped_boxes, label_states, source_counts
from pipelines.smoothing.config import SmoothConfig
from pipelines.smoothing.label_spool import LabelSpool
from pipelines.smoothing.lifetimes import Lifetimes
from pipelines.smoothing.online import track_evidence
from pipelines.smoothing.rounds import SmoothedObjects, smooth_objects
from pipelines.tracking import OnlineTracker, Progress
from saga_fg.arrays import BoolArray, FloatArray, IntArray
from saga_fg.dataset import Scene
from saga_fg.frame import Frame
from saga_fg.settings import require_positive, setting
from saga_fg.smoothing import (
    Evidence,
    LabelCounts,
    gather_evidence,
    looks_in_view,
    measured_in_order,
    size_weights,
)


@dataclass(frozen=True)
class StretchSettings:
    """How a long recording is cut."""

    length: float = setting(30.0, "of a stretch, s")
    margin: float = setting(20.0, "that is smoothed with it at either end, s")

    def __post_init__(self) -> None:
        require_positive(self, "length", "margin")


@dataclass(frozen=True, eq=False)
class StreamedScene:
    """A recording that was smoothed as it was read. counts: where its boxes come from; frames taken in; seconds spent;
    spool: its labels, on disk."""

    name: str
    counts: LabelCounts
    frames: int
    seconds: float
    spool: LabelSpool


def smooth_stream(
    parts: Iterable[Scene],
    config: SmoothConfig,
    folder: Path,
    method: Method = "saga",
    stretches: StretchSettings | None = None,
    progress: Progress | None = None,
) -> Iterator[StreamedScene]:
    """Smooth recordings that come in parts: successive scenes of the same name, each beginning after the one before.

    folder: where labels wait on disk; it must outlive the scenes. The frames of a part are of its timestamps. Raises
    `InputError` for what the parts are refused for.
    """
    for number, (name, scene) in enumerate(groupby(parts, key=lambda part: part.name)):
        spool = LabelSpool(folder / f"{number:06d}", name, config.smoothing)
        run = _Run(name, config, method, stretches or StretchSettings(), spool)
        yield run.over(scene, progress)


@dataclass(frozen=True, eq=False)
class _Taken:
    """A frame, its time of measurement (s), and the tracks (n,) of its usable detections, -1 for none."""

    time: float
    frame: Frame
    track_of: IntArray


@dataclass
class _Sums:
    """What is counted while a recording goes by."""

    counts: LabelCounts = field(default_factory=LabelCounts)
    looks: int = 0
    first_look: float = np.inf
    last_look: float = -np.inf


class _Run:
    """One recording."""

    def __init__(
        self, name: str, config: SmoothConfig, method: Method, stretches: StretchSettings, spool: LabelSpool
    ) -> None:
        self._name, self._config, self._stretches, self._spool = name, config, stretches, spool
        self._tracking = config.tracking.of_method(method)
        self._tracker: OnlineTracker = self._tracking.new_tracker(method)
        offsets = [0.0, *(sensor.time_offset for sensor in config.sensors.values())]
        self._early = min(offsets)  # a frame's measurement may be this much before its timestamp
        self._coming: list[Frame] = []
        self._taken: list[_Taken] = []
        self._moments = np.empty(0)
        self._begin = -np.inf
        self._lifetimes = Lifetimes()
        self._owner: dict[int, tuple[int, float]] = {}  # tracklet -> its object, and when it was last given out
        self._sums = _Sums()

    def over(self, parts: Iterable[Scene], progress: Progress | None) -> StreamedScene:
        """Take in everything."""
        frames, cpu = 0, 0.0
        for part in parts:
            begin = time.perf_counter()
            with threadpool_limits(limits=1, user_api="blas"):  # as for whole scenes
                self._coming += part.frames
                self._moments = np.concatenate([self._moments, part.timestamps])
                self._track(float(part.timestamps[-1]) + self._early)
                self._smooth(self._taken[-1].time if self._taken else -np.inf)
            frames += len(part.frames)
            cpu += time.perf_counter() - begin
            if progress is not None:
                progress(self._name, frames, frames)
        begin = time.perf_counter()
        with threadpool_limits(limits=1, user_api="blas"):
            self._track(np.inf)
            self._smooth(np.inf)
            self._lifetimes.retire(np.empty(0, dtype=np.int64))
        sums = self._sums
        rate = (sums.looks - 1) / (sums.last_look - sums.first_look) if sums.last_look > sums.first_look else 1.0
        self._spool.finish(self._lifetimes, self._config.smoothing.prior_time * rate)
        counts = replace(sums.counts, objects=len(self._lifetimes.ids))
        return StreamedScene(self._name, counts, frames, cpu + time.perf_counter() - begin, self._spool)

    def _track(self, until: float) -> None:
        """The online pass over what was measured before a time."""
        sensors, classes = self._config.sensors, self._tracking.tracker.classes
        ordered = measured_in_order(self._coming, sensors)
        ready = [(at, frame) for at, frame in ordered if at < until]
        if not ready:
            return
        self._coming = [frame for at, frame in ordered if at >= until]
        frames = [frame for _, frame in ready]
        evidence = gather_evidence(frames, np.empty(0), sensors, classes)
        track_of = track_evidence(self._name, frames, self._tracker, evidence, sensors, classes)
        rows = evidence.rows_of_look()
        self._taken += [_Taken(at, f, track_of[mine]) for (at, f), mine in zip(ready, rows, strict=True)]

    def _smooth(self, until: float) -> None:
        """All stretches that are complete, with their margins, before a time; infinite: all that is left."""
        length, margin = self._stretches.length, self._stretches.margin
        if self._begin == -np.inf and (self._taken or len(self._moments)):
            self._begin = min([*self._moments[:1].tolist(), *(taken.time for taken in self._taken[:1])])
        while self._begin + length + margin < until:
            last = until == np.inf and self._begin + length + margin >= self._newest
            end = np.inf if last else self._begin + length
            if not len(self._moments):
                return
            self._stretch(self._begin, end)
            if last:
                return
            old = end - margin
            self._taken = [taken for taken in self._taken if taken.time >= old]
            self._moments = self._moments[self._moments >= old]
            oldest = min([*self._moments[:1].tolist(), *(taken.time for taken in self._taken[:1])], default=end)
            self._begin = end + max(0.0, (oldest - margin - end) // length) * length  # past stretches of nothing

    @property
    def _newest(self) -> float:
        return max([*self._moments[-1:].tolist(), *(taken.time for taken in self._taken[-1:])], default=-np.inf)

    def _stretch(self, begin: float, end: float) -> None:
        """Smooth around [begin, end) and give out what is in it."""
        config, margin = self._config, self._stretches.margin
        within = [taken for taken in self._taken if begin - margin <= taken.time < end + margin]
        wanted = self._moments[(self._moments >= begin - margin) & (self._moments < end + margin)]
        frames = [taken.frame for taken in within]
        evidence = gather_evidence(frames, wanted, config.sensors, self._tracking.tracker.classes)
        track_of = np.concatenate([np.empty(0, dtype=np.int64), *(taken.track_of for taken in within)])
        if not len(evidence.times):
            return
        objects = smooth_objects(evidence, track_of, config.smoothing, self._tracking.tracker)
        labelled = label_states(evidence, objects, wanted, config.smoothing)
        inside = (evidence.times >= begin) & (evidence.times < end)
        names = self._names(evidence, objects, labelled, inside)
        self._gather(evidence, objects, labelled, names, inside)
        mine = wanted[(wanted >= begin) & (wanted < end)]
        self._give_out(evidence, objects, labelled, names, mine)
        kept = end - 2 * (self._stretches.length + margin)
        self._owner = {track: owner for track, owner in self._owner.items() if owner[1] >= kept}

    def _names(
        self, evidence: Evidence, objects: SmoothedObjects, labelled: LabelledStates, inside: BoolArray
    ) -> dict[int, int]:
        """The lasting ids of the objects that are there in the stretch: those that their tracklets have already."""
        here = np.unique(labelled.states.id[inside[labelled.states.moment]])
        times = evidence.times[evidence.moment]
        end = evidence.times[inside][-1] if inside.any() else -np.inf
        names: dict[int, int] = {}
        rows = np.flatnonzero((objects.object_of >= 0) & (objects.track_of >= 0))
        rows = rows[np.isin(objects.object_of[rows], here)]
        pairs = np.unique(np.stack([objects.object_of[rows], objects.track_of[rows]], axis=1), axis=0)
        tracklets, begins = np.unique(objects.track_of[rows], return_index=True)  # detections are in order of time
        first = dict(zip(tracklets.tolist(), times[rows[begins]].tolist(), strict=True))
        for id_ in here.tolist():
            tracks = sorted((int(t) for t in pairs[pairs[:, 0] == id_, 1]), key=lambda t: first[t])
            known = [self._owner[t][0] for t in tracks if t in self._owner]
            name = next((k for k in known if k not in names.values()), id_)
            names[id_] = name if name not in names.values() else id_
            for k, track in enumerate(tracks):
                if k == 0 or first[track] <= end:
                    if track != names[id_] and track not in self._owner:
                        self._sums.counts = LabelCounts.sum([self._sums.counts, LabelCounts(joined=1)])
                    self._owner[track] = (names[id_], end)
        return names

    def _gather(
        self,
        evidence: Evidence,
        objects: SmoothedObjects,
        labelled: LabelledStates,
        names: Mapping[int, int],
        inside: BoolArray,
    ) -> None:
        """Sum up what the stretch says of its objects as wholes."""
        rows = np.flatnonzero((objects.object_of >= 0) & inside[evidence.moment])
        weight = size_weights(evidence.probability, evidence.distance)
        for id_, mine in _by_id(objects.object_of, rows):
            if id_ in names:
                seen = evidence.boxes.size[mine]
                self._lifetimes.seen(names[id_], evidence.probability[mine], seen, weight[mine])
        looks = tuple(look for look in evidence.looks if inside[look.moment])
        count = looks_in_view(replace(evidence, looks=looks), objects.lives, labelled.states)
        for id_, looked in zip(objects.lives.id.tolist(), count.tolist(), strict=True):
            if id_ in names:
                self._lifetimes.looked(names[id_], looked)
        times = evidence.times[[look.moment for look in looks]].tolist()
        sums = self._sums
        sums.looks += len(looks)
        sums.first_look, sums.last_look = min([sums.first_look, *times]), max([sums.last_look, *times])

    def _give_out(
        self,
        evidence: Evidence,
        objects: SmoothedObjects,
        labelled: LabelledStates,
        names: Mapping[int, int],
        wanted: FloatArray,
    ) -> None:
        """Spool the labels of the moments `wanted`, s, and remember which way they look."""
        states, headings = labelled.states, labelled.headings
        at = np.searchsorted(evidence.times, wanted)
        emitted = np.flatnonzero(np.isin(states.moment, at))
        if len(at):
            before = int(at[0]) - 1
            turned = {
                id_: self._turned(labelled, names[id_], id_, before) for id_ in np.unique(states.id[emitted]).tolist()
            }
            inside = np.flatnonzero((states.moment > before) & (states.moment <= at[-1]))
            for id_, rows in _by_id(states.id, inside):
                if id_ in turned:
                    path, votes = float(headings.path[rows].sum()), float(headings.votes[rows].sum())
                    self._lifetimes.given_out(names[id_], turned[id_], float(headings.yaw[rows[-1]]), path, votes)
            self._spool.add(wanted, at, labelled, names, turned)
        begun = [(at[:1] <= gone.first) & (gone.first <= at[-1:]) for gone in objects.dropped]
        new = LabelCounts(
            **source_counts(labelled.source[emitted]),
            dropped=dropped_boxes(evidence, objects, wanted),
            dropped_objects=sum(int(each.sum()) for each in begun),
        )
        self._sums.counts = LabelCounts.sum([self._sums.counts, new])
        self._lifetimes.retire(np.array([names[id_] for id_ in names], dtype=np.int64))

    def _turned(self, labelled: LabelledStates, name: int, id_: int, before: int) -> float:
        row = labelled.states.rows_of(np.array([before]), np.array([id_]))[0] if before >= 0 else -1
        return self._lifetimes.turned(name, float(labelled.headings.yaw[row]) if row >= 0 else np.nan)


def _by_id(id_: IntArray, rows: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Each id among those of `rows` (m,), ascending, and its rows; id_ (R,)."""
    rows = rows[np.argsort(id_[rows], kind="stable")]
    ids, starts = np.unique(id_[rows], return_index=True)
    yield from zip(ids.tolist(), np.split(rows, starts)[1:], strict=True)
