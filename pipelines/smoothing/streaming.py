"""Recordings smoothed chunk by chunk as they are read, in memory that does not grow with their length.

    frames -> tracker, frame by frame -> chunks, smoothed one by one with margins -> labels, on disk

The tracker sees the recording once, from one end to the other. All passes of smoothing (`pipelines.smoothing.passes`)
are made anew for every chunk. Size, score, front and identity of objects are gathered
over the chunks (`pipelines.smoothing.labelling`) and put in at the end, when the labels are read back from disk.
Memory is that of a chunk with its margins, and a few numbers for every object that ever was.

A recording at hand is one chunk. Where there are several, stationary and weak objects are judged by a chunk with its
margins. Chunks follow each other without a gap.

    [a, b) is smoothed within [a - margin, b + margin]        b = a + length, earlier where there are enough detections

Labels are written for the moments of the chunk alone; beyond the margins measurements have no influence on it. Memory
and work follow the detections in a chunk and its margins, so that crowds are cut into shorter ones.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np

from pipelines.config import Method
from pipelines.smoothing.labelling import (
    Identities,
    LabelledStates,
    LabelSpool,
    ObjectSummary,
    SmoothedScene,
    dropped_boxes,
    label_states,
    source_counts,
)
from pipelines.smoothing.passes import SmoothConfig, SmoothedObjects, smooth_objects, track_evidence
from pipelines.tracking import OnlineTracker, Progress, one_thread, scene_with_frames
from saga_fg.graph import FactorProvider
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.settings import Positive, Range, Settings, setting
from saga_fg.smoothing import (
    Evidence,
    LabelCounts,
    gather_evidence,
    measured_in_order,
    opportunities,
    size_weights,
)
from saga_fg.smoothing.settings import PRIOR_OPPORTUNITY_TIME
from saga_fg.types.dataset import Dataset, Scene
from saga_fg.types.frame import Frame

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
        settings, count = self._settings, 0
        for tracked in self._frames:
            if tracked.time >= begin:
                count += len(tracked.track_of)
                if count >= settings.detections:
                    return min(max(tracked.time, begin + MIN_LENGTH), begin + settings.length)
        return begin + settings.length

    def _oldest(self, otherwise: float) -> float:
        """Time of the first frame or moment that is left, s."""
        return min([*self._moments[:1].tolist(), *(tracked.time for tracked in self._frames[:1])], default=otherwise)


def smooth_scene(
    scene: Scene,
    config: SmoothConfig,
    method: Method = "saga",
    progress: Progress | None = None,
    providers: Sequence[FactorProvider] = (),
) -> SmoothedScene:
    """Smooth one recording at once, with the edges of the tracker's settings unless `method` is another than `saga`.

    providers: of factors of your own, in place of those that the configuration names
    """
    with TemporaryDirectory() as folder:
        spool = LabelSpool(Path(folder) / "labels", scene.name)
        run = _Run(scene.name, config, method, WHOLE, spool, providers).over([scene], progress)
        return replace(run, parts=((scene, run.labels),))


def smooth_dataset(
    dataset: Dataset,
    config: SmoothConfig,
    method: Method = "saga",
    scenes: Iterable[str] | None = None,
    progress: Progress | None = None,
) -> Iterator[SmoothedScene]:
    """Smooth some recordings (default: all), one at a time as they are asked for."""
    for name in dataset.scenes if scenes is None else scenes:
        yield smooth_scene(scene_with_frames(dataset, name), config, method, progress)


def smooth_stream(
    parts: Iterable[Scene],
    config: SmoothConfig,
    folder: Path,
    method: Method = "saga",
    chunks: ChunkSettings | None = None,
    progress: Progress | None = None,
) -> Iterator[SmoothedScene]:
    """Smooth recordings that come in parts: successive scenes of the same name, each beginning after the one before.

    folder: where labels wait on disk; it must outlive the scenes. The frames of a part are of its timestamps. Raises
    `InputError` for what the parts are refused for.
    """
    for number, (name, scene) in enumerate(groupby(parts, key=lambda part: part.name)):
        spool = LabelSpool(folder / f"{number:06d}", name)
        yield _Run(name, config, method, chunks or ChunkSettings(), spool).over(scene, progress)


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
    """Counts while a recording streams by."""

    counts: LabelCounts = LabelCounts()
    frames: int = 0
    first: float = np.inf
    last: float = -np.inf

    @property
    def rate(self) -> float:
        """Frames per second."""
        return (self.frames - 1) / (self.last - self.first) if self.last > self.first else 1.0


class _Run:
    """One recording."""

    def __init__(
        self,
        name: str,
        config: SmoothConfig,
        method: Method,
        chunks: ChunkSettings,
        spool: LabelSpool,
        providers: Sequence[FactorProvider] = (),
    ) -> None:
        self._name, self._config, self._chunks, self._spool = name, config, chunks, spool
        self._providers = providers
        self._tracking = config.tracking.of_method(method)
        self._tracker: OnlineTracker = self._tracking.new_tracker(method)
        offsets = [0.0, *(sensor.time_offset for sensor in config.sensors.values())]
        self._early = min(offsets)  # a frame's measurement may be this much before its timestamp
        self._coming: list[Frame] = []
        self._backlog = Backlog(chunks)
        self._identities = Identities()
        self._summaries: defaultdict[int, ObjectSummary] = defaultdict(ObjectSummary)
        self._present: set[int] = set()  # in the latest chunk
        self._sums = _Sums()

    def over(self, parts: Iterable[Scene], progress: Progress | None) -> SmoothedScene:
        """Take in everything."""
        frames, done, seconds = 0, 0, 0.0

        def advance(_: str, count: int, __: int) -> None:
            if progress is not None:
                progress(self._name, done + count, frames)

        for part in chain(parts, [None]):
            begin, until = time.perf_counter(), np.inf
            if part is not None:
                frames += len(part.frames)
                self._coming += part.frames
                self._backlog.want(part.timestamps)
                until = float(part.timestamps[-1]) + self._early
            with one_thread():
                done += self._track(until, advance)
                self._smooth(until if part is None else self._backlog.tracked)
            seconds += time.perf_counter() - begin
        self._spool.finish(self._summaries, PRIOR_OPPORTUNITY_TIME * self._sums.rate)
        counts = replace(self._sums.counts, objects=len(self._summaries), joined=self._identities.joined)
        return SmoothedScene(self._name, self._spool, counts, frames, seconds)

    def _track(self, until: float, progress: Progress) -> int:
        """The online pass over what was measured before a time; the number of these frames."""
        sensors, classes = self._config.sensors, self._tracking.tracker.classes
        ordered = measured_in_order(self._coming, sensors)
        ready = [(at, frame) for at, frame in ordered if at < until]
        if ready:
            self._coming = [frame for at, frame in ordered if at >= until]
            frames = [frame for _, frame in ready]
            evidence = gather_evidence(frames, np.empty(0), sensors, classes)
            track_of = track_evidence(self._name, frames, self._tracker, evidence, sensors, classes, progress)
            rows = zip(ready, evidence.rows_of_frame(), strict=True)
            self._backlog.extend([TrackedFrame(at, frame, track_of[mine]) for (at, frame), mine in rows])
        return len(ready)

    def _smooth(self, until: float) -> None:
        """All chunks that are complete, with their margins, before a time; infinite: all that is left."""
        for begin, end in self._backlog.chunks(until):
            tracked, wanted = self._backlog.around(begin, end)
            frames = [each.frame for each in tracked]
            evidence = gather_evidence(frames, wanted, self._config.sensors, self._tracking.tracker.classes)
            if len(evidence.times):
                track_of = np.concatenate([np.empty(0, dtype=np.int64), *(each.track_of for each in tracked)])
                objects = smooth_objects(
                    evidence, track_of, self._config.smoothing, self._tracking.tracker, self._providers
                )
                labelled = label_states(evidence, objects, wanted, self._config.smoothing)
                mine = wanted[(wanted >= begin) & (wanted < end)]
                self._add(_Chunk(begin, end, evidence, objects, labelled), mine)

    def _add(self, chunk: _Chunk, wanted: FloatArray) -> None:
        """Add a chunk to the summaries of its objects, and write its labels at the times `wanted`, s."""
        evidence, objects, states = chunk.evidence, chunk.objects, chunk.labelled.states
        here = np.unique(states.id[chunk.inside[states.moment]])
        times, span = evidence.times[evidence.moment], (chunk.begin, chunk.end)
        names = self._identities.name(here, objects.object_of, objects.track_of, times, span)
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
        weight = size_weights(evidence.probability, evidence.distance)
        total = np.bincount(objects.object_of[rows], evidence.probability[rows]).tolist()
        for id_, mine in _by_id(objects.object_of, rows):
            if id_ in names:
                self._summaries[names[id_]].add_detections(total[id_], evidence.boxes.size[mine], weight[mine])
        frames = tuple(frame for frame in evidence.frames if inside[frame.moment])
        count = opportunities(replace(evidence, frames=frames), objects.lifespans, objects.judged)
        for id_, looked in zip(objects.lifespans.id.tolist(), count.tolist(), strict=True):
            if id_ in names:
                self._summaries[names[id_]].opportunities += looked
        times = evidence.times[[frame.moment for frame in frames]].tolist()
        sums = self._sums
        sums.frames += len(frames)
        sums.first, sums.last = min([sums.first, *times]), max([sums.last, *times])

    def _write(self, chunk: _Chunk, names: Mapping[int, int], wanted: FloatArray) -> None:
        """Spool the labels of the moments `wanted`, s, and add their headings to the summaries."""
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
            self._spool.add(wanted, at, labelled, names, signs)
        new = LabelCounts(
            **source_counts(labelled.columns.source[emitted]),
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
