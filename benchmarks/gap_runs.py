"""Runs of trackers through gaps of recordings, real and made, judged by identity and place.

A real gap lasts from the last moment at which a labelled object has a detection to the next one. Made gaps and errors
are those of `pipelines.learning.interactions`.

kept   the track that holds the object `SETTLING` s after the gap is the one that held it before
error  distance of that track, while it is not detected, to the label, m; `CAP` where it is not known or farther away
link   a track that is detected again after `SHORTEST` s or more; it is right if it holds the object it held before,
       false if it holds another, unknown if it holds none before or after
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, Protocol

import numpy as np

from benchmarks.situations import UNDER_WAY, situations_of
from data_tools.metrics import nees
from pipelines.learning.interactions import CAP, DETECTED, Contender, Errors, JudgedRun, classes_of, tracks_without
from pipelines.tracking import Progress
from saga_fg.learning.labelled_scene import LENGTHS, LONGEST, Gap, LabelledScene, is_moving, made_gaps, reached
from saga_fg.model import Sensor
from saga_fg.numerics import FloatArray
from saga_fg.types import Scene, Tracks

SHORTEST = 1.0  # s: real gaps
SEEN_BEFORE = 0.39  # s from the first to the last detection before a real gap: half a second of frames at 10 Hz
Life = Literal["kept", "shipped"]
LIVES: tuple[Life, ...] = ("kept", "shipped")


def real_gaps(labelled: LabelledScene) -> list[Gap]:
    """All gaps of `SHORTEST` to `LONGEST` s after which the object is detected again."""
    time, found = labelled.scene.timestamps, []
    for row in range(len(labelled.id)):
        seen = np.flatnonzero(labelled.detected[:, row])
        begins = np.flatnonzero(np.diff(seen) > 1)
        spell = 0.0 if len(seen) == 0 else float(time[seen[0]])
        for last, first in zip(seen[begins].tolist(), seen[begins + 1].tolist(), strict=True):
            length = float(time[first] - time[last])
            if length < SHORTEST - 1e-6:
                continue
            if length <= LONGEST + 1e-6 and time[last] - spell >= SEEN_BEFORE:
                found.append(Gap(row, last, first, length, is_moving(labelled, row, last, first)))
            spell = float(time[first])
    return found


@dataclass(frozen=True)
class Prediction:
    """A track without detections against the label of its object.

    error   m, however large;  nees: its square by the covariance of the position, chi-squared with 2 degrees of freedom
    nll     negative logarithm of the density of the true position, nats;  NaN, as nees, without a covariance
    """

    error: float
    nees: float
    nll: float


@dataclass(frozen=True)
class Judgement:
    """The outcome of a gap of an object.

    at          error at the end of each length that the gap reaches, m
    predicted   where the track that had the object is then, if it is among the results
    held, kept  whether a track had the object before, and whether that track has it after
    reported    whether that track is among the results at the last moment of the gap
    error       mean over the gap, m
    """

    at: Errors
    predicted: Mapping[float, Prediction]
    held: bool
    kept: bool
    reported: bool
    error: float


@dataclass(frozen=True)
class Links:
    """Tracks that were detected again after a gap, by whom they hold."""

    right: int = 0
    false: int = 0
    unknown: int = 0


@dataclass(frozen=True)
class LivedRun:
    """A contender's outcomes in the gaps of one recording; its tracks are kept alive, or end as configured.

    cluster     the first of the recordings that overlap with this one, or itself
    situations  of the object of each gap, by the length until which; none for real gaps
    links       of the run with all detections, if that was
    """

    recording: str
    cluster: str
    contender: str
    gaps: tuple[Gap, ...]
    label: tuple[str, ...]
    situations: tuple[Mapping[float, frozenset[str]], ...]
    outcomes: tuple[Judgement, ...]
    life: Life
    links: Links | None


class ExtrapolatedRun(JudgedRun):
    """A run in which a track that is not reported is taken to move on as it was last reported."""

    def position(self, track: int, moment: int) -> FloatArray | None:
        """The place (2,) of a track, None before it was reported."""
        for k in range(moment, -1, -1):
            row, found = self.row_of[k].get(track), self.tracks[k]
            if row is not None:
                elapsed = float(self.tracks[moment].timestamp - found.timestamp)
                return np.asarray(found.boxes.position[row, :2] + elapsed * found.boxes.velocity[row])
        return None


CURVE = "curve"
"""Contender: the tracks of `kf`, hidden ones by `CurveRun`."""
FITTED, FADING, LATERAL = 1.0, 4.0, 4.0  # s; s; m/s^2


class CurveRun(JudgedRun):
    """A run whose tracks go on in a curve while they are hidden, independent of the engine.

    By a line through the velocities v that were reported in the last `FITTED` s in view, each track has an acceleration
    a along its course and a curvature k, which lasts. The acceleration fades (Singer, IEEE Trans. AES 6, 1970):

        dv/dt = a exp(-t / FADING),  v >= 0,      d course / ds = k

    Covariances stay those of the tracker.
    """

    def __init__(self, labelled: LabelledScene, tracks: Sequence[Tracks]) -> None:
        past: dict[int, list[tuple[float, FloatArray, FloatArray]]] = {}
        curved = []
        for found in tracks:
            position = found.boxes.position.copy()
            for row, node in enumerate(found.id.tolist()):
                own, hidden = past.setdefault(node, []), found.coasting[row] > DETECTED
                if not hidden:
                    own.append((found.timestamp, position[row, :2].copy(), found.boxes.velocity[row]))
                elif own:
                    position[row, :2] = self._onward(own, found.timestamp)
            curved.append(replace(found, boxes=replace(found.boxes, position=position)))
        super().__init__(labelled, curved)

    @staticmethod
    def _onward(own: list[tuple[float, FloatArray, FloatArray]], until: float) -> FloatArray:
        """The place (2,) at a time, by times, places and velocities in view."""
        time, place, velocity = own[-1]
        near = [one for one in own if one[0] >= time - FITTED]
        v = float(np.hypot(*velocity))
        ahead = velocity / max(v, 1e-6)
        at, known = np.array([one[0] for one in near]) - time, np.array([one[2] for one in near])
        spread = ((at - at.mean()) ** 2).sum()
        pull = (at - at.mean()) @ known / spread if spread > 0 else np.zeros(2)
        a, across = float(pull @ ahead), float(np.clip(pull @ [-ahead[1], ahead[0]], -LATERAL, LATERAL))
        curvature = across / v**2 if v > UNDER_WAY else 0.0
        t = np.linspace(0.0, until - time, max(2, round(10 * (until - time)) + 1))
        speed = np.maximum(v + a * FADING * (1 - np.exp(-t / FADING)), 0.0)
        speed[np.minimum.accumulate(speed) == 0] = 0.0
        step = (speed[1:] + speed[:-1]) / 2 * np.diff(t)
        course = np.arctan2(velocity[1], velocity[0]) + curvature * (np.cumsum(step) - step / 2)
        return np.asarray(place + (step[:, None] * np.column_stack([np.cos(course), np.sin(course)])).sum(axis=0))


HINDSIGHT = "edges by hindsight"
"""Contender: of `saga` and `trails alone` the one with the lower error in each gap, the limit of choosing edges."""


def by_hindsight(runs: Sequence[LivedRun]) -> list[LivedRun]:
    """Runs of `HINDSIGHT` where there are both."""
    alone = {(run.recording, run.life): run for run in runs if run.contender == "trails alone"}
    pairs = [
        (run, alone[key]) for run in runs if run.contender == "saga" and (key := (run.recording, run.life)) in alone
    ]
    return [
        replace(mine, contender=HINDSIGHT, outcomes=tuple(map(_better, mine.outcomes, other.outcomes)))
        for mine, other in pairs
    ]


def _better(one: Judgement, other: Judgement) -> Judgement:
    """The lower error of two, at the end of each length and over the gap."""
    whole, other = (other, one) if other.error < one.error else (one, other)
    at, predicted = dict(other.at), dict(other.predicted)
    at |= {h: error for h, error in whole.at.items() if error <= at.get(h, np.inf)}
    mine = {h: found for h, found in whole.predicted.items() if h not in predicted or found.error < predicted[h].error}
    return replace(whole, at=at, predicted=predicted | mine)


def judgement(run: JudgedRun, gap: Gap) -> Judgement:
    """Judge one gap."""
    holder, at = run.holder(gap), run.outcome(gap)
    if holder is None:
        return Judgement(at, {}, False, False, False, CAP)
    ends = reached(run.labelled.scene.timestamps, gap)
    predicted = {h: found for h, k in ends.items() if (found := prediction(run, holder, gap.row, k)) is not None}
    after = run.last(run.track_of, str(run.labelled.id[gap.row]), gap.stop, back=False)
    errors = np.array([run.error(holder, gap.row, k) for k in range(gap.start + 1, gap.stop)])
    known = errors[np.isfinite(errors)]
    mean = float(known.mean()) if len(known) else float("nan")
    reported = holder in run.row_of[gap.stop - 1]
    return Judgement(at, predicted, True, after == holder, reported, mean)


def prediction(run: JudgedRun, track: int, row: int, moment: int) -> Prediction | None:
    """The track at a moment, None where it is not among the results or the object is not labelled."""
    truth, at = run.labelled.position[moment, row], run.row_of[moment].get(track)
    if at is None or not np.isfinite(truth[0]):
        return None
    error = run.tracks[moment].boxes.position[at, :2] - truth
    covariance = run.tracks[moment].position_covariance[at]
    squared = float(nees(error[None], covariance[None])[0])
    nll = (squared + np.linalg.slogdet(2 * np.pi * covariance)[1]) / 2 if np.isfinite(squared) else np.nan
    return Prediction(float(np.hypot(*error)), squared, float(nll))


def links(run: JudgedRun) -> Links:
    """Judge all tracks that were detected again."""
    time = run.labelled.scene.timestamps
    object_of = [{track: name for name, track in found.items()} for found in run.track_of]
    latest: dict[int, int] = {}
    right = false = unknown = 0
    for k, detected in enumerate(run.detected):
        for track in set(detected.id.tolist()):
            since = latest.get(track)
            latest[track] = k
            if since is None or not SHORTEST - 1e-6 <= time[k] - time[since] <= LONGEST + 1e-6:
                continue
            before = run.last(object_of, track, since, back=True)
            after = run.last(object_of, track, k, back=False)
            if before is None or after is None:
                unknown += 1
            elif before == after:
                right += 1
            else:
                false += 1
    return Links(right, false, unknown)


class SceneSource(Protocol):
    """Recordings by name, with ground truth and detections; clusters: the first of the recordings that overlap in time
    with each, by name, empty where none can."""

    @property
    def name(self) -> str: ...
    @property
    def clusters(self) -> Mapping[str, str]: ...
    def scene(self, recording: str) -> Scene: ...


@dataclass(frozen=True)
class GapBenchSettings:
    """Passes over each recording with made gaps, the lives compared, lengths of made gaps, s.

    real  whether the gaps of the recordings themselves are judged too, and the links
    of    situations, one of which objects are in at the end of made gaps; none: any
    """

    passes: int = 2
    lives: tuple[Life, ...] = LIVES
    lengths: tuple[float, ...] = LENGTHS
    real: bool = True
    of: tuple[str, ...] = ()


def bench_gaps(
    source: SceneSource,
    recordings: Sequence[str],
    contenders: Sequence[Contender],
    settings: GapBenchSettings,
    progress: Progress | None = None,
) -> list[LivedRun]:
    """All runs on some recordings of a set, of contenders that have the same sensors."""
    runs = list[LivedRun]()
    for name in recordings:
        labelled, gaps = prepared(source, name, settings, contenders[0].config.sensors)
        for contender, life in product(contenders, settings.lives):
            runs.append(run_of(labelled, gaps, contender, life, settings.real, source.clusters.get(name, name)))
            if progress is not None:
                each = len(contenders) * len(settings.lives)
                progress(f"{source.name} {name} {contender.name}", len(runs), len(recordings) * each)
    return runs


def prepared(
    source: SceneSource, recording: str, settings: GapBenchSettings, sensors: Mapping[str, Sensor]
) -> tuple[LabelledScene, list[Gap]]:
    """A recording and its gaps."""
    labelled = LabelledScene.from_scene(source.scene(recording), sensors)
    real = real_gaps(labelled) if settings.real else []

    def wanted(gap: Gap) -> bool:
        return not situations_of(labelled, gap).get(gap.length, frozenset()).isdisjoint(settings.of)

    chosen = wanted if settings.of else None
    return labelled, [*real, *made_gaps(labelled, settings.passes, 0, settings.lengths, chosen)]


def run_of(
    labelled: LabelledScene,
    gaps: Sequence[Gap],
    contender: Contender,
    life: Life,
    real: bool = True,
    cluster: str | None = None,
) -> LivedRun:
    """Track without the detections of each pass, and before, for `real` gaps and links, with all; judge."""
    outcomes: dict[int, Judgement] = {}
    found = Links() if real else None
    for number in sorted({*([0] if real else []), *(gap.run for gap in gaps)}):
        mine = {k: gap for k, gap in enumerate(gaps) if gap.run == number}
        judged = judged_run(labelled, list(mine.values()), contender, life)
        outcomes |= {k: judgement(judged, gap) for k, gap in mine.items()}
        if number == 0:
            found = links(judged)
    name, ordered = labelled.scene.name, tuple(outcomes[k] for k in range(len(gaps)))
    situations = tuple(situations_of(labelled, gap) if gap.run > 0 else {} for gap in gaps)
    classes = classes_of(labelled, gaps)
    return LivedRun(name, cluster or name, contender.name, tuple(gaps), classes, situations, ordered, life, found)


def judged_run(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender, life: Life) -> JudgedRun:
    """Track without the detections of the made ones among the gaps of one run."""
    made, lived = [gap for gap in gaps if gap.run > 0], contender.kept_alive() if life == "kept" else contender
    kind = ExtrapolatedRun if contender.method == "centerpoint" else JudgedRun
    kind = CurveRun if contender.name == CURVE else kind
    return kind(labelled, tracks_without(labelled, made, lived))
