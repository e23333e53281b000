"""Baseline without a filter: gradient-boosted trees that predict where a hidden object is.

For each length of a gap two regressors, along and across the heading at the start, predict how far the object gets from
where constant velocity takes it, from the features of `benchmarks.gaps.features`. They learn from all windows of
the recordings to learn from in which an object could be hidden. They track nothing: there is neither identity nor
covariance.

Source: Friedman, Greedy function approximation: a gradient boosting machine, Annals of Statistics 29(5), 2001.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from benchmarks.gaps.features import Features
from benchmarks.gaps.sources import RecordingSource
from pipelines.learning.gap_judging import CAP, GapOutcome, Prediction
from pipelines.learning.gap_runs import GapBenchSettings, Run, prepared
from saga_fg.errors import InputError, MissingExtraError
from saga_fg.learning.gaps import LENGTHS, Gap, reached, windows
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.learning.situations import situations_of
from saga_fg.model.sensor import Sensor
from saga_fg.numerics.arrays import FloatArray, IntArray

NAME = "gradient boosting"
FEWEST = 100  # windows to learn from
TREES = {"loss": "absolute_error", "max_iter": 200, "learning_rate": 0.06, "max_leaf_nodes": 15, "random_state": 0}


@dataclass(frozen=True, eq=False)
class BoostedTrees:
    """For each length that could be learned: the features that it was learned from, the regressors along and across."""

    regressors: Mapping[float, tuple[IntArray, Any, Any]]

    @classmethod
    def fitted(cls, recordings: Sequence[LabelledScene]) -> Self:
        """Learn from some recordings.

        Raises `MissingExtraError` without scikit-learn, `InputError` for recordings with too few windows.
        """
        regressor = _regressor()
        found: dict[float, tuple[IntArray, Any, Any]] = {}
        for length in LENGTHS:
            rows: list[FloatArray] = []
            targets: list[FloatArray] = []
            for labelled in recordings:
                for gap in windows(labelled, np.random.default_rng(0), (length,)):
                    features = Features.of(labelled, gap)
                    if features is not None:
                        rows.append(features.until(gap.stop - 1))
                        targets.append(features.offset(labelled.position[gap.stop - 1, gap.row], gap.stop - 1))
            if len(rows) >= FEWEST:
                x, y = np.array(rows), np.array(targets)
                known = np.flatnonzero(np.isfinite(x).any(axis=0))
                found[length] = (known, *(regressor(**TREES).fit(x[:, known], axis) for axis in y.T))
        if not found:
            raise InputError(f"--fit boosted: expected recordings with {FEWEST} windows to learn from, there are fewer")
        return cls(found)

    def outcome(self, labelled: LabelledScene, gap: Gap) -> GapOutcome:
        """The errors at the ends of the lengths; nothing about identity."""
        features = Features.of(labelled, gap)
        predicted: dict[float, Prediction] = {}
        if features is not None:
            for length, moment in reached(labelled.scene.timestamps, gap).items():
                truth = labelled.position[moment, gap.row]
                if length in self.regressors and np.isfinite(truth[0]):
                    known, *axes = self.regressors[length]
                    row = features.until(moment)[None, known]
                    offset = np.array([float(each.predict(row)[0]) for each in axes])
                    error = float(np.hypot(*(features.place(offset, moment) - truth)))
                    predicted[length] = Prediction(error, float("nan"), float("nan"))
        at = {length: min(each.error, CAP) for length, each in predicted.items()}
        return GapOutcome(True, None, None, float("nan"), at, predicted)


def boosted_runs(
    source: RecordingSource,
    train: Sequence[str],
    test: Sequence[str],
    settings: GapBenchSettings,
    sensors: Mapping[str, Sensor],
) -> list[Run]:
    """Learn from some recordings, and be judged on the made gaps of others; nothing if no tracks are kept alive."""
    if "kept" not in settings.lives:
        return []
    trees = BoostedTrees.fitted([LabelledScene.of(source.scene(name), sensors) for name in train])
    cluster, runs = source.clusters, []
    for name in test:
        labelled, gaps = prepared(source, name, settings, sensors)
        gaps = [gap for gap in gaps if gap.run > 0]
        label = tuple(str(labelled.label[gap.row]) for gap in gaps)
        situations = tuple(situations_of(labelled, gap) for gap in gaps)
        outcomes = tuple(trees.outcome(labelled, gap) for gap in gaps)
        runs.append(Run(name, cluster.get(name, name), NAME, "kept", tuple(gaps), label, situations, outcomes, None))
    return runs


def _regressor() -> Any:
    try:
        from sklearn.ensemble import HistGradientBoostingRegressor
    except ImportError as error:
        raise MissingExtraError("--fit boosted needs scikit-learn: pip install 'saga-fg[bench]'") from error
    return HistGradientBoostingRegressor
