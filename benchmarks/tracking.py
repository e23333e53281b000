"""The methods, and the graph-aware tracker with each component off, on the same recordings.

Every variant tracks every scene, in turn, so that whatever else the machine does hits all alike; times are CPU times of
the tracker alone. Differences come with intervals of a paired bootstrap over scenes (`data_tools.metrics.bootstrap`):
errors at labels from their sums, the figures averaged over recall by scoring each drawn set of scenes anew.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.predictions import PredictionErrors, PredictionRecorder
from benchmarks.recordings import RecordingSet, Score
from benchmarks.variants import GRAPH_MATCHING, Variant, variants
from data_tools.evaluation.hota import HotaRow
from data_tools.metrics import Interval, LabelErrors, paired_bootstrap
from pipelines.config import TrackConfig
from pipelines.learning.interactions import learn_interactions
from pipelines.observers import StageClock
from pipelines.tracking import OnlineTracker, Progress, TrackedScene, track_scene
from saga_fg.errors import InputError
from saga_fg.model.learned_interactions import LearnedInteractions
from saga_fg.tracking import Tracker
from saga_fg.types.frame import Frame
from saga_fg.types.track import Tracks

SAGA, KF, BASELINE = "saga", "kf", "centerpoint"
LEARNED = Variant("learned interactions")
FOLDS = 2  # of scenes that interactions are learned from
RELATIVE_SWITCHES = "IDS, relative"
LOWER_IS_BETTER = ("AMOTP", "IDS", "FRAG", "RMSE", RELATIVE_SWITCHES)


@dataclass(frozen=True)
class TrackingBenchSettings:
    """Size of the benchmark.

    components  whether to switch components off one by one
    contenders  whether to track by graph matching and by interactions learned on other scenes of the set, and to judge
                by HOTA
    draws       sets of scenes drawn for the intervals of figures averaged over recall; 0: no intervals of these
    """

    components: bool = True
    contenders: bool = False
    draws: int = 200
    seed: int = 0


@dataclass(frozen=True, eq=False)
class VariantResult:
    """One variant on one set: headline figures, errors at labels scene by scene, ms of CPU time a frame.

    stages       ms a frame by stage, of the trackers that tell (not `centerpoint`)
    predictions  errors of predictions, scene by scene, of the methods that predict covariances (not `centerpoint`)
    """

    variant: Variant
    score: Score
    figures: Mapping[str, float]
    milliseconds: float
    stages: Mapping[str, float]
    predictions: tuple[PredictionErrors, ...]


@dataclass(frozen=True, eq=False)
class SetResult:
    """All variants on one set, and what the graph changes: less kf (relative for errors), by variant and figure."""

    name: str
    scenes: tuple[str, ...]
    variants: Mapping[str, VariantResult]
    differences: Mapping[str, Mapping[str, Interval]]

    def ratio(self, variant: str) -> float:
        """Time a frame over that of `centerpoint`."""
        return self.variants[variant].milliseconds / self.variants[BASELINE].milliseconds

    def errors(self, variant: str) -> LabelErrors:
        """At the labels of all scenes."""
        return LabelErrors.pool(self.variants[variant].score.errors)


class _Timed:
    """A tracker with a clock; with `predictions`, recorded while the clock stands still."""

    def __init__(self, tracker: OnlineTracker, stages: StageClock, predictions: PredictionRecorder | None) -> None:
        self.seconds, self._tracker, self._stages, self._predictions = 0.0, tracker, stages, predictions

    def step(self, frame: Frame) -> Tracks:
        self._stages.start()
        begin = time.thread_time()
        tracks = self._tracker.step(frame)
        self.seconds += time.thread_time() - begin
        if self._predictions is not None and isinstance(self._tracker, Tracker):
            self._predictions.after(self._tracker, tracks)
        return tracks

    def tracks(self, timestamp: float) -> Tracks:
        begin = time.thread_time()
        tracks = self._tracker.tracks(timestamp)
        self.seconds += time.thread_time() - begin
        return tracks


def bench_set(
    recordings: RecordingSet,
    base: TrackConfig,
    settings: TrackingBenchSettings | None = None,
    progress: Progress | None = None,
) -> SetResult:
    """Compare on one set."""
    settings = settings or TrackingBenchSettings()
    compared = variants(base, settings.components, settings.contenders)
    learned: dict[str, LearnedInteractions] = {}
    if settings.contenders:
        learned = learn_by_folds(recordings, base, progress)
        compared += (LEARNED,)
    runs: dict[str, dict[str, TrackedScene]] = {variant.name: {} for variant in compared}
    seconds, clocks = dict.fromkeys(runs, 0.0), {name: StageClock() for name in runs}
    scenes = recordings.dataset.scenes
    predictions: dict[str, list[PredictionErrors]] = {name: [] for name in runs}
    for name in scenes:
        scene = recordings.dataset.scene(name)
        for done, variant in enumerate(compared):
            clock = clocks[variant.name]
            config = base.with_interactions(learned[name]) if variant is LEARNED else variant.config(base)
            recorder = PredictionRecorder() if variant.name in (SAGA, KF) else None
            timed = _Timed(config.new_tracker(variant.method, clock), clock, recorder)
            runs[variant.name][name] = track_scene(scene, timed)
            seconds[variant.name] += timed.seconds
            if recorder is not None:
                predictions[variant.name].append(recorder.errors(scene))
            if progress is not None:
                progress(f"{recordings.name} {name}", done + 1, len(compared))
    results = {}
    for variant in compared:
        tracked = runs.pop(variant.name)
        score = recordings.score(tracked)
        if settings.contenders:
            score = score.with_hota()
        per_frame = 1000 / max(sum(run.frames for run in tracked.values()), 1)
        stages = {stage: per_frame * spent for stage, spent in clocks[variant.name].seconds.items()}
        spent = per_frame * seconds[variant.name]
        judged = {f"HOTA {row.label}": row.figures.hota for row in _in_space(score)} if settings.contenders else {}
        ahead = tuple(predictions[variant.name])
        results[variant.name] = VariantResult(variant, score, score.figures | judged, spent, stages, ahead)
    compared_with_kf = (SAGA, GRAPH_MATCHING.name, LEARNED.name) if settings.contenders else (SAGA,)
    differences = {
        name: graph_differences(results[name].score, results[KF].score, settings)
        for name in compared_with_kf
        if name in results
    }
    return SetResult(recordings.name, scenes, results, differences)


def _in_space(score: Score) -> list[HotaRow]:
    """HOTA of cars by their overlap in space."""
    return [row for row in score.hota() if row.label == "car" and row.overlap == "3D"]


def learn_by_folds(
    recordings: RecordingSet, base: TrackConfig, progress: Progress | None = None
) -> dict[str, LearnedInteractions]:
    """Interactions for every scene, learned from the truth of the scenes of the other fold.

    Scenes that overlap are in one fold. Raises `InputError` for a single one.
    """
    scenes = recordings.dataset.scenes
    unit = {name: recordings.clusters.get(name, name) for name in scenes}
    units = list(dict.fromkeys(unit.values()))
    if len(units) < FOLDS:
        raise InputError(f"{', '.join(scenes)}: expected scenes to learn from beside it")
    learned: dict[str, LearnedInteractions] = {}
    for fold in range(FOLDS):
        tested = [name for name in scenes if unit[name] in units[fold::FOLDS]]
        read = (recordings.dataset.scene(name) for name in scenes if name not in tested)
        others = {scene.name: scene for scene in read}  # several may have the same truth
        found = learn_interactions(others, f"scenes {', '.join(others)}", base, progress=progress)
        learned |= dict.fromkeys(tested, found.interactions)
    return learned


def graph_differences(saga: Score, kf: Score, settings: TrackingBenchSettings) -> dict[str, Interval]:
    """Saga against kf: headline figures as differences, RMSEs as relative changes.

    Needs two scenes that don't overlap; else empty.
    """
    units = saga.units
    if len(units) < 2:
        return {}
    result = {}
    if settings.draws:
        result = sampled_differences(saga.figures_of, kf.figures_of, units, settings.draws, settings.seed)
    for name in ("position", "velocity", "heading"):
        a, b = (
            [np.sum([score.errors[row].sample(name).square_sums for row in unit], axis=0) for unit in units]
            for score in (saga, kf)
        )
        result[f"{name} RMSE"] = paired_bootstrap(a, b, seed=settings.seed)
    return result


def sampled_differences(
    first: Callable[[Sequence[int]], Mapping[str, float]],
    second: Callable[[Sequence[int]], Mapping[str, float]],
    units: Sequence[Sequence[int]],
    draws: int,
    seed: int = 0,
    confidence: float = 0.95,
) -> dict[str, Interval]:
    """First less second in each figure that both have, and relative switches, with intervals.

    units  numbers of the scenes; those of one unit are drawn together
    """
    rng = np.random.default_rng(seed)
    sampled: dict[str, list[float]] = {}
    for _ in range(draws):
        rows = [row for unit in rng.integers(len(units), size=len(units)).tolist() for row in units[unit]]
        for name, value in _differences(first(rows), second(rows)).items():
            sampled.setdefault(name, []).append(value)
    tail = (1 - confidence) / 2
    every = [row for unit in units for row in unit]
    estimate = _differences(first(every), second(every))
    result = {}
    for name, values in sampled.items():
        known = [value for value in values if math.isfinite(value)]
        if name in estimate and known:
            low, high = np.quantile(known, [tail, 1 - tail]).tolist()
            result[name] = Interval(estimate[name], low, high, confidence)
    return result


def _differences(ours: Mapping[str, float], theirs: Mapping[str, float]) -> dict[str, float]:
    """In each figure that both have, and of switches the relative change as well."""
    found = {name: value - theirs[name] for name, value in ours.items() if name in theirs}
    if "IDS" in found:
        found[RELATIVE_SWITCHES] = found["IDS"] / theirs["IDS"] if theirs["IDS"] else math.nan
    return found


def verdict(name: str, difference: Interval) -> str:
    """`better`, `worse`, or `no difference` where the interval holds 0."""
    if not difference.excludes(0.0):
        return "no difference"
    lower = name.endswith(LOWER_IS_BETTER)
    return "better" if (difference.estimate < 0) == lower else "worse"
