"""A recording labelled chunk by chunk as it comes, in memory that does not grow with its length.

    frames -> tracker, frame by frame -> chunks, smoothed one by one with margins -> labels

The tracker sees the recording once, from one end to the other. All passes of smoothing (`saga_fg.smoothing.passes`)
are made anew for every chunk. Size, score, front and identity of objects are gathered
over the chunks (`saga_fg.smoothing.labelling`) and put in at the end, when the labels are read back.
Memory is that of a chunk with its margins, and a few numbers for every object that ever was.

A recording at hand is one chunk. Where there are several, stationary and weak objects are judged by a chunk with its
margins. Chunks follow each other without a gap.

    [a, b) is smoothed within [a - margin, b + margin]        b = a + length, earlier where there are enough detections

Labels are written for the moments of the chunk alone; beyond the margins measurements have no influence on it. Memory
and work follow the detections in a chunk and its margins, so that crowds are cut into shorter ones.

`smooth` labels a whole table of detections in one call, beside `saga_fg.track`.
"""

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from saga_fg.graph import FactorProvider
from saga_fg.model import Sensor
from saga_fg.numerics import BoolArray, FloatArray, IntArray
from saga_fg.settings import Positive, Range, Settings, setting
from saga_fg.smoothing.association import Evidence, gather_evidence, measured_in_order, opportunities
from saga_fg.smoothing.boxes import size_weights
from saga_fg.smoothing.correcting import LATE, PERSON, correct_objects
from saga_fg.smoothing.corrections import Correction, WholeObject, checked_corrections, corrections_in, unfit
from saga_fg.smoothing.labelling import (
    Identities,
    LabelledStates,
    LabelParts,
    ObjectSummary,
    RecordingLabels,
    dropped_boxes,
    label_states,
)
from saga_fg.smoothing.passes import SmoothedObjects, smooth_objects, track_evidence
from saga_fg.smoothing.settings import PRIOR_OPPORTUNITY_TIME, SmoothingSettings
from saga_fg.smoothing.states import LabelCounts, Labels
from saga_fg.tables import Table, TableImport, table_like
from saga_fg.tracking import GreedyTracker, Method, SettingsName, Tracker, TrackerSettings, read_scenes, scaled_sensors
from saga_fg.types import Frame

MIN_LENGTH = 5.0  # s, of a chunk that ends early: below the margins at its ends, which are smoothed again, take over


@dataclass(frozen=True)
class ChunkSettings(Settings):
    """Lengths of the chunks of a long recording."""

    length: Positive = setting(30.0, "length of a chunk, s; higher: more memory")
    margin: Positive = setting(7.0, "time smoothed beyond either end of a chunk, s")
    detections: Annotated[int, Range(1, 10**9)] = setting(60_000, "number of detections that ends a chunk early")


WHOLE = ChunkSettings(length=1e12, detections=10**9)  # one chunk


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame, its time of measurement (s), and the tracks (n,) of its usable detections, -1 for none."""

    time: float
    frame: Frame
    track_of: IntArray


class Backlog:
    """The part of a recording still needed: tracked frames in order of time, and moments at which boxes are wanted."""

    def __init__(self, settings: ChunkSettings) -> None:
        self._settings = settings
        self._frames: list[TrackedFrame] = []
        self._moments = np.empty(0)
        self._begin: float | None = None  # of the next chunk

    def extend(self, frames: list[TrackedFrame]) -> None:
        """Take in frames that were tracked."""
        self._frames += frames

    def want(self, moments: FloatArray) -> None:
        """Boxes are wanted at these times (m,), s, too: later ones than before."""
        self._moments = np.concatenate([self._moments, moments])

    @property
    def tracked(self) -> float:
        """Time of the newest frame, s; -inf before the first."""
        return self._frames[-1].time if self._frames else -np.inf

    def chunks(self, until: float) -> Iterator[tuple[float, float]]:
        """The spans [begin, end), s, that are complete, with their margins, before a time; infinite: all that is left.

        Frames that later chunks do not need are forgotten when the next chunk is asked for.
        """
        length, margin = self._settings.length, self._settings.margin
        if self._begin is None:
            if not self._frames and not len(self._moments):
                return
            self._begin = self._oldest(np.inf)
        while len(self._moments):
            end = self._end(self._begin)
            last = until == np.inf and end + margin >= max(self._moments[-1], self.tracked)
            if end + margin >= until and not last:
                return
            yield self._begin, (np.inf if last else end)
            if last:
                return
            self._frames = [tracked for tracked in self._frames if tracked.time >= end - margin]
            self._moments = self._moments[self._moments >= end - margin]
            pause = self._oldest(end) - margin - end
            self._begin = end + max(0.0, pause // length) * length  # past empty chunks

    def around(self, begin: float, end: float) -> tuple[list[TrackedFrame], FloatArray]:
        """The frames of a chunk with its margins, and the times (m,), s, that are wanted."""
        first, last = begin - self._settings.margin, end + self._settings.margin
        wanted = self._moments[(self._moments >= first) & (self._moments < last)]
        return [tracked for tracked in self._frames if first <= tracked.time < last], wanted

    def _end(self, begin: float) -> float:
        """End of a chunk: after its length, or once it has enough detections."""
        mine = [tracked for tracked in self._frames if tracked.time >= begin]
        count, longest = np.cumsum([len(tracked.track_of) for tracked in mine]), begin + self._settings.length
        enough = np.flatnonzero(count >= self._settings.detections)
        return min(max(mine[enough[0]].time, begin + MIN_LENGTH), longest) if len(enough) else longest

    def _oldest(self, otherwise: float) -> float:
        """Time of the first frame or moment that is left, s."""
        return min([*self._moments[:1].tolist(), *(tracked.time for tracked in self._frames[:1])], default=otherwise)


@dataclass(frozen=True, eq=False)
class LabelModel:
    """Everything that determines labels: settings of the tracker, of the sensors offline and of smoothing, providers of
    factors in place of those that the settings name, and corrections."""

    tracker: TrackerSettings
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    smoothing: SmoothingSettings = field(default_factory=SmoothingSettings)
    providers: Sequence[FactorProvider] = ()
    corrections: Sequence[Correction] = ()

    @cached_property
    def offline(self) -> TrackerSettings:
        """Settings of the tracker in the passes: without edges where `smoothing` has none."""
        return self.tracker if self.smoothing.edges else replace(self.tracker, edges=())


@dataclass(frozen=True, eq=False)
class _Chunk:
    """The span [begin, end), s, smoothed with its margins."""

    begin: float
    end: float
    evidence: Evidence
    objects: SmoothedObjects
    labelled: LabelledStates

    @cached_property
    def inside(self) -> BoolArray:
        """(K,) which moments of the evidence are in the chunk itself."""
        return (self.evidence.times >= self.begin) & (self.evidence.times < self.end)


@dataclass
class _Sums:
    """Counts while a recording streams by: boxes, frames smoothed and tracked, their first and last times, s."""

    counts: LabelCounts = LabelCounts()
    frames: int = 0
    tracked: int = 0
    first: float = np.inf
    last: float = -np.inf

    @property
    def rate(self) -> float:
        """Frames per second."""
        return (self.frames - 1) / (self.last - self.first) if self.last > self.first else 1.0


class LabelBuilder:
    """Makes the labels of one recording, which comes in parts.

    tracker  a fresh one, for the online pass
    chunks   lengths of the chunks; by default the recording is one
    parts    where labels wait
    """

    def __init__(
        self,
        tracker: Tracker | GreedyTracker,
        model: LabelModel,
        chunks: ChunkSettings | None = None,
        parts: LabelParts | None = None,
    ) -> None:
        self._tracker, self._model, self._chunks = tracker, model, chunks or WHOLE
        offsets = [0.0, *(sensor.time_offset for sensor in model.sensors.values())]
        self._early = min(offsets)  # a frame's measurement may be this much before its timestamp
        self._coming: list[Frame] = []
        self._backlog = Backlog(self._chunks)
        self._whole: tuple[Evidence, SmoothedObjects, FloatArray] | None = None  # before corrections, of one chunk
        self._reset([] if parts is None else parts)

    def _reset(self, parts: LabelParts) -> None:
        self._labels = RecordingLabels(parts)
        self._outcome: dict[int, str] = {}  # by number of the correction: why it does not hold, or ""
        self._identities = Identities()
        self._summaries: defaultdict[int, ObjectSummary] = defaultdict(ObjectSummary)
        self._present: set[int] = set()  # in the latest chunk
        self._sums = _Sums()

    def add(self, frames: Sequence[Frame], wanted: FloatArray, progress: Callable[[int], None] | None = None) -> None:
        """Take in the frames up to the last of the times `wanted` (m,), s, at which boxes are wanted; later ones come
        with later parts. progress: called with the frames tracked so far."""
        self._coming += frames
        self._backlog.want(wanted)
        self._track(float(wanted[-1]) + self._early, progress)
        self._smooth(self._backlog.tracked)

    def finish(self, progress: Callable[[int], None] | None = None) -> tuple[RecordingLabels, LabelCounts]:
        """The labels, and where they come from, when all parts are there."""
        self._track(np.inf, progress)
        self._smooth(np.inf)
        return self._finished()

    def _finished(self) -> tuple[RecordingLabels, LabelCounts]:
        self._labels.finish(self._summaries, PRIOR_OPPORTUNITY_TIME * self._sums.rate)
        objects = sum(each.said.exists is not False for each in self._summaries.values())
        counts = replace(self._sums.counts, objects=objects, joined=self._identities.joined)
        return self._labels, LabelCounts.sum([counts, self._labels.counts()])

    def corrected(self, corrections: Sequence[Correction]) -> tuple[RecordingLabels, LabelCounts]:
        """The labels of a recording that is finished and was one chunk, with these corrections in place of others: the
        objects concerned alone are solved again."""
        assert self._whole is not None
        self._model = replace(self._model, corrections=corrections)
        self._reset([])
        self._label(-np.inf, np.inf, *self._whole)
        return self._finished()

    @property
    def noise(self) -> dict[str, float]:
        """Scale of each sensor's noise, by name, estimated from its detections; 1 is its noise model."""
        return {name: one.scale for name, one in self._tracker.sensor_noise.items()}

    @property
    def outcomes(self) -> tuple[tuple[Correction, str], ...]:
        """The corrections, and why they do not hold; "" where they do."""
        given, end = enumerate(self._model.corrections), self._sums.last
        late = f"stands beyond the end of the recording at {end:g} s"
        found = ((one, self._outcome.get(k, "outside the recording")) for k, one in given)
        return tuple((one, why or (late if one.until > end + LATE else "")) for one, why in found)

    def _track(self, until: float, progress: Callable[[int], None] | None) -> None:
        """The online pass over what was measured before a time."""
        sensors, classes = self._model.sensors, self._model.tracker.classes
        ordered = measured_in_order(self._coming, sensors)
        ready = [(at, frame) for at, frame in ordered if at < until]
        if not ready:
            return
        self._coming = [frame for at, frame in ordered if at >= until]
        frames, done = [frame for _, frame in ready], self._sums.tracked

        def advance(count: int) -> None:
            self._sums.tracked = done + count
            if progress is not None:
                progress(done + count)

        evidence = gather_evidence(frames, np.empty(0), sensors, classes)
        track_of = track_evidence(frames, self._tracker, evidence, sensors, classes, advance)
        rows = zip(ready, evidence.rows_of_frame(), strict=True)
        self._backlog.extend([TrackedFrame(at, frame, track_of[mine]) for (at, frame), mine in rows])

    def _smooth(self, until: float) -> None:
        """All chunks that are complete, with their margins, before a time; infinite: all that is left."""
        model = self._model
        sensors = scaled_sensors(model.sensors, self._tracker.sensor_noise)
        for begin, end in self._backlog.chunks(until):
            tracked, wanted = self._backlog.around(begin, end)
            frames = [each.frame for each in tracked]
            evidence = gather_evidence(frames, wanted, sensors, model.tracker.classes)
            if len(evidence.times):
                track_of = np.concatenate([np.empty(0, dtype=np.int64), *(each.track_of for each in tracked)])
                objects = smooth_objects(evidence, track_of, model.smoothing, model.offline, model.providers)
                if self._chunks is WHOLE:
                    self._whole = evidence, objects, wanted
                self._label(begin, end, evidence, objects, wanted)

    def _label(
        self, begin: float, end: float, evidence: Evidence, objects: SmoothedObjects, wanted: FloatArray
    ) -> None:
        """The labels of a chunk, as corrected."""
        model, whole = self._model, {}
        near = evidence.times[[0, -1]] + [-LATE, LATE]
        given = [(k, one) for k, one in enumerate(model.corrections) if near[0] <= one.at.time <= near[1]]
        if given:
            found = correct_objects(evidence, objects, given, model.smoothing, model.offline, model.providers)
            evidence, objects, whole = found.evidence, found.objects, found.whole
            for number, one in given:
                if begin <= one.at.time < end or number not in self._outcome:
                    self._outcome[number] = found.outcome[number]
        labelled = label_states(evidence, objects, wanted, model.smoothing)
        mine = wanted[(wanted >= begin) & (wanted < end)]
        self._add(_Chunk(begin, end, evidence, objects, labelled), mine, whole)

    def _add(self, chunk: _Chunk, wanted: FloatArray, whole: Mapping[int, WholeObject]) -> None:
        """Add a chunk to the summaries of its objects, and write its labels at the times `wanted`, s; whole: what was
        said of objects."""
        evidence, objects, states = chunk.evidence, chunk.objects, chunk.labelled.states
        here = np.unique(states.id[chunk.inside[states.moment]])
        times, span = evidence.times[evidence.moment], (chunk.begin, chunk.end)
        names = self._identities.name(here, objects.object_of, objects.track_of, times, span)
        for id_, said in whole.items():
            if id_ in names:
                self._summaries[names[id_]].said = self._summaries[names[id_]].said.updated(said)
        self._gather(chunk, names)
        self._write(chunk, names, wanted)
        present = set(names.values())
        for id_ in self._present - present:
            self._summaries[id_].close()
        self._present = present
        self._identities.forget(chunk.begin - 2 * (self._chunks.length + self._chunks.margin))

    def _gather(self, chunk: _Chunk, names: Mapping[int, int]) -> None:
        """Add the chunk's evidence on whole objects."""
        evidence, objects, inside = chunk.evidence, chunk.objects, chunk.inside
        rows = np.flatnonzero((objects.object_of >= 0) & inside[evidence.moment])
        weight = size_weights(evidence)
        _, number = np.unique(objects.object_of[rows], return_inverse=True)
        totals = np.bincount(number, evidence.probability[rows]).tolist()
        for (id_, mine), total in zip(_by_id(objects.object_of, rows), totals, strict=True):
            if id_ in names:
                self._summaries[names[id_]].add_detections(total, evidence.boxes.size[mine], weight[mine])
        frames = tuple(frame for frame in evidence.frames if inside[frame.moment] and frame.sensor is not PERSON)
        states, log_step = chunk.labelled.states, chunk.labelled.log_step
        for id_, mine in _by_id(states.id, np.flatnonzero(inside[states.moment] & (log_step < 0))):
            self._summaries[names[id_]].add_steps(log_step[mine], evidence.times[states.moment[mine]])
        count = opportunities(replace(evidence, frames=frames), objects.lifespans, objects.judged)
        for id_, looked in zip(objects.lifespans.id.tolist(), count.tolist(), strict=True):
            if id_ in names:
                self._summaries[names[id_]].opportunities += looked
        times = evidence.times[[frame.moment for frame in frames]].tolist()
        self._sums.frames += len(frames)
        self._sums.first, self._sums.last = min([self._sums.first, *times]), max([self._sums.last, *times])

    def _write(self, chunk: _Chunk, names: Mapping[int, int], wanted: FloatArray) -> None:
        """Add the labels of the moments `wanted`, s, and add their headings to the summaries."""
        evidence, objects, labelled = chunk.evidence, chunk.objects, chunk.labelled
        states, headings = labelled.states, labelled.headings
        at = np.searchsorted(evidence.times, wanted)
        emitted = np.flatnonzero(np.isin(states.moment, at))
        if len(at):
            before = int(at[0]) - 1
            signs = {
                id_: self._heading_sign(labelled, names[id_], id_, before)
                for id_ in np.unique(states.id[emitted]).tolist()
            }
            after = len(evidence.times) if chunk.end == np.inf else int(at[-1]) + 1
            inside = np.flatnonzero((states.moment > before) & (states.moment < after))
            for id_, rows in _by_id(states.id, inside):
                if id_ in signs:
                    path, votes = float(headings.path[rows].sum()), float(headings.votes[rows].sum())
                    self._summaries[names[id_]].add_headings(signs[id_], float(headings.yaw[rows[-1]]), path, votes)
            for id_, rows in _by_id(states.id, emitted):
                self._summaries[names[id_]].boxes += len(rows)
                self._summaries[names[id_]].rivals += int(labelled.rival[rows].sum())
            self._labels.add(wanted, at, labelled, names, signs)
        new = LabelCounts(
            dropped=dropped_boxes(evidence, objects, wanted),
            dropped_objects=int(chunk.inside[objects.dropped.first].sum()),
        )
        self._sums.counts = LabelCounts.sum([self._sums.counts, new])

    def _heading_sign(self, labelled: LabelledStates, name: int, id_: int, before: int) -> float:
        row = labelled.states.rows_of(np.array([before]), np.array([id_]))[0] if before >= 0 else -1
        return self._summaries[name].heading_sign(float(labelled.headings.yaw[row]) if row >= 0 else np.nan)


def _by_id(id_: IntArray, rows: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Each id among those of `rows` (m,), ascending, and its rows; id_ (R,)."""
    rows = rows[np.argsort(id_[rows], kind="stable")]
    ids, starts = np.unique(id_[rows], return_index=True)
    yield from zip(ids.tolist(), np.split(rows, starts)[1:], strict=True)


@dataclass(frozen=True, eq=False)
class TableLabels:
    """The labels of the scenes of a table of detections, by name.

    detections: whose kind of table `boxes` and `review` give; named: they have a column `scene`
    """

    scenes: Mapping[str, RecordingLabels]
    detections: Table
    named: bool

    def __repr__(self) -> str:
        """The numbers of scenes and boxes, and the objects most worth a look."""
        boxes = sum(len(moment.tracks) for one in self.scenes.values() for part in one for moment in part)
        title = f"labels of {len(self.scenes)} scenes, {boxes} boxes (.boxes()); objects most worth a look (.review()):"
        return f"{title}\n{self.review()}"

    def boxes(self) -> Table:
        """A row for each box, with the columns of `labels.csv`."""
        found = [(name, moment) for name, one in self.scenes.items() for part in one for moment in part]
        return self._table([(name, moment.table_columns()) for name, moment in found], Labels.empty().table_columns())

    def review(self) -> Table:
        """A row for each object worth a look, with the columns of `review.csv`: in each scene those first that are most
        worth it."""
        found = [(name, one.review().table_columns()) for name, one in self.scenes.items()]
        return self._table(found, RecordingLabels([]).review().table_columns())

    def _table(self, parts: Sequence[tuple[str, Mapping[str, Any]]], none: Mapping[str, Any]) -> Table:
        found = []
        for name, columns in parts or [("", none)]:
            scene = {"scene": np.full(len(columns["id"]), name)} if self.named else {}
            found.append({**scene, **columns})
        return table_like(self.detections, found)


def smooth(
    detections: Table,
    settings: TrackerSettings | SettingsName | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    smoothing: SmoothingSettings | None = None,
    corrections: Iterable[Correction | Mapping[str, Any]] = (),
    how: TableImport | None = None,
    method: Method = "saga",
) -> TableLabels:
    """Label a table of detections, of pandas, Polars or Arrow, with past and future of every object.

    detections, settings, sensors, how, method  as of `saga_fg.track`; by default labels begin with an object's first
                 detection
    smoothing    settings of the passes over the whole table; by default without edges where traffic is dense
    corrections  by a person, as `Correction` or as a mapping like a line of a file of corrections

    Warns (`UserWarning`) as `saga_fg.track` does, and of each correction that does not hold. Raises `InputError` for a
    table or a correction that can't be used.
    """
    given = checked_corrections(corrections)
    found = read_scenes(detections, how, settings, sensors, method)
    if not isinstance(settings, TrackerSettings):
        found = found._replace(settings=replace(found.settings, min_hits=1))
    labels, outcomes = {}, []
    smoothing = SmoothingSettings(edges=not found.dense) if smoothing is None else smoothing
    for scene in found.scenes:
        mine = corrections_in(scene.name, given)
        model = LabelModel(found.settings, found.sensors, smoothing, (), mine)
        builder = LabelBuilder(found.new_tracker(), model)
        builder.add(scene.frames, scene.timestamps)
        labels[scene.name], _ = builder.finish()
        outcomes += [(one.origin, why) for one, why in builder.outcomes]
    for problem in unfit(given, outcomes):
        warnings.warn(problem, stacklevel=2)
    return TableLabels(labels, detections, found.is_named)
