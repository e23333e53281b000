"""Contenders whose noise and edges are fitted to recordings that are not judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from benchmarks.gaps.boosted import boosted_runs
from benchmarks.gaps.sources import RecordingSource
from pipelines.config import TrackConfig
from pipelines.learning import learned_motions
from pipelines.learning.gap_runs import Contender, GapBenchSettings, Run, bench_gaps
from pipelines.learning.interactions import LEARNED, LearningSettings, learn_interactions
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.learning import measured_trajectories

Fit = Literal["noise", "edges", "boosted"]
FITS: tuple[Fit, ...] = ("noise", "edges", "boosted")
LEARNING = LearningSettings(passes=1, most=100)  # there is a fit to every fold, and a half of the usual tells enough


@dataclass(frozen=True)
class Split:
    """Recordings to fit to, and others to judge on."""

    train: tuple[str, ...]
    test: tuple[str, ...]


def splits_of(
    recordings: Sequence[str],
    train: Sequence[str] = (),
    test: Sequence[str] = (),
    folds: int | None = None,
    unit: Mapping[str, str] | None = None,
) -> list[Split]:
    """Split the recordings of a set; `train` and `test` may name recordings of other sets as well.

    test   those that are judged; all but `train` if it is empty
    folds  deal the judged recordings into so many, each judged after a fit to the others; 0: into units
    unit   what recordings are dealt by: those of one unit are in one fold; each by itself where it has none

    Raises `InputError` for more folds than units, and for units of which there is one.
    """
    unit = unit or {}
    judged = [name for name in recordings if (name in test if test else name not in train)]
    if folds is None:
        return [Split(tuple(name for name in recordings if name in train), tuple(judged))] if judged else []
    units = list(dict.fromkeys(unit.get(name, name) for name in judged))
    if folds == 0 and len(units) == 1:
        raise InputError(f"--folds place: expected recordings of two places or more, all are of {units[0]}")
    if folds > len(units):
        raise InputError(f"--folds {folds}: expected at most the number of recordings, {len(units)}")
    dealt = [set(units[k :: folds or len(units)]) for k in range(folds or len(units))]
    parts = [tuple(name for name in judged if unit.get(name, name) in fold) for fold in dealt]
    return [Split(tuple(name for name in judged if name not in part), part) for part in parts]


def bench_splits(
    source: RecordingSource,
    splits: Sequence[Split],
    contenders: Sequence[Contender],
    base: TrackConfig,
    settings: GapBenchSettings,
    fits: Sequence[Fit] = ("noise", "edges"),
    workers: int = 1,
    progress: Progress | None = None,
) -> list[Run]:
    """All runs on the recordings that are judged; where there are others to fit to, with fitted contenders.

    Raises `InputError` where there is nothing to learn from, `MissingExtraError` for boosted trees without
    scikit-learn.
    """
    runs: list[Run] = []
    settings = replace(settings, real=settings.real and not source.complete)
    for split in splits:
        fitted: list[Contender] = []
        if split.train and "noise" in fits:
            fitted.append(_with_fitted_noise(source, split, base))
        if split.train and "edges" in fits:
            fitted.append(_with_learned_edges(source, split, base, progress, workers))
        runs += _judged(source, split, contenders, fitted, settings, workers, progress)
        if split.train and "boosted" in fits:
            runs += boosted_runs(source, split.train, split.test, settings, base.sensors)
    return runs


def _judged(
    source: RecordingSource,
    split: Split,
    contenders: Sequence[Contender],
    fitted: Sequence[Contender],
    settings: GapBenchSettings,
    workers: int,
    progress: Progress | None,
) -> list[Run]:
    """The runs of all; where two fits give the same settings, the recordings are run once for both."""
    same = {one.name: next((other.name for other in contenders if one.same_as(other)), None) for one in fitted}
    different = [one for one in fitted if same[one.name] is None]
    runs = bench_gaps(source, split.test, [*contenders, *different], settings, workers, progress)
    copies = [(name, run) for name, other in same.items() for run in runs if run.contender == other]
    return [*runs, *(replace(run, contender=name) for name, run in copies)]


def _with_fitted_noise(source: RecordingSource, split: Split, base: TrackConfig) -> Contender:
    """kf with the motions of some annotated recordings."""
    scenes = (source.scene(name) for name in split.train)
    motions = learned_motions(measured_trajectories(scenes, base.sensors), base)
    return Contender("kf, fitted noise", "kf", base.with_motions(motions))


def _with_learned_edges(
    source: RecordingSource, split: Split, base: TrackConfig, progress: Progress | None, workers: int
) -> Contender:
    """Saga with the edges of some annotated recordings."""
    scenes = {name: source.scene(name) for name in split.train}
    origin = f"recordings {', '.join(scenes)}"
    learned = learn_interactions(scenes, origin, base, settings=LEARNING, progress=progress, workers=workers)
    return Contender(f"saga, {LEARNED}", "saga", base.with_interactions(learned.interactions))
