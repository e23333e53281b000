r"""Errors of predictions at fixed horizons, of objects that are detected when they are predicted.

    error     |x - m|, m
    NLL       -log N(x; m, P) = (nees + log det(2 pi P)) / 2
    coverage  share of errors inside the p-ellipses of P

for the true position x and the prediction N(m, P). A track is that of the object of its class that is nearest, within
`GATE`; an object *moves* if it travels faster than `MOVING` until then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from data_tools.metrics import Interval, paired_bootstrap
from data_tools.metrics.bootstrap import ratio_of_sums
from data_tools.metrics.consistency import coverages, nees, negative_log_density
from data_tools.metrics.matching import match_scene
from saga_fg import PredictedTracks, Scene, Tracker, Tracks
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.columns import Columns
from saga_fg.types.labelled_objects import LabelledObjects

HORIZONS = (1.0, 2.0, 3.0, 5.0)  # s
EVERY = 1.0  # s between predictions
GATE = 2.0  # m, between an object and its track
MOVING = 0.5  # m/s
DETECTED = 0.15  # s since its latest detection: a track counts as visible
FEWEST_UNITS = 3  # of scenes that do not overlap, for an interval


@dataclass(frozen=True, eq=False)
class PredictionErrors(Columns):
    """N predictions: horizon (N,), s; error (N,), m; nll (N,), nees (N,), moving (N,)."""

    horizon: FloatArray
    error: FloatArray
    nll: FloatArray
    nees: FloatArray
    moving: BoolArray


class PredictionRecorder:
    """The predictions of a tracker at work, every `EVERY` s."""

    def __init__(self) -> None:
        self._found: list[tuple[Tracks, PredictedTracks]] = []

    def after(self, tracker: Tracker, tracks: Tracks) -> None:
        """Record predictions after a frame, if it is time, from its `tracks`."""
        if not self._found or tracks.timestamp >= self._found[-1][0].timestamp + EVERY - 1e-6:
            self._found.append((tracks, tracker.predict(HORIZONS)))

    def errors(self, scene: Scene) -> PredictionErrors:
        """Compare with the truth of the scene."""
        truth = _Truth(scene)
        found = [truth.errors(tracks, predicted) for tracks, predicted in self._found]
        return PredictionErrors.concatenate([_nothing(), *found])


class _Truth:
    """The places of the objects of a scene over its time."""

    def __init__(self, scene: Scene) -> None:
        assert scene.ground_truth is not None
        self._moments, self._objects = scene.ground_truth, LabelledObjects.of(scene)

    def errors(self, tracks: Tracks, predicted: PredictedTracks) -> PredictionErrors:
        """Errors of the predictions made at one moment."""
        moment = self._moments[int(np.argmin(np.abs(self._objects.time - tracks.timestamp)))]
        visible = tracks.select((tracks.coasting <= DETECTED) & np.isin(tracks.id, predicted.id))
        pairs = match_scene([moment], [visible], GATE)[0]
        rows = np.searchsorted(predicted.id, visible.id[pairs.track_row])
        objects = np.searchsorted(self._objects.id, moment.id[pairs.object_row])
        now = self._objects.at(tracks.timestamp)[objects]
        parts = [_nothing()]
        for k, horizon in enumerate(predicted.horizons.tolist()):
            then = self._objects.at(tracks.timestamp + horizon)[objects]
            known = np.isfinite(then[:, 0]) & np.isfinite(now[:, 0])
            error, P = (predicted.position[k, rows] - then)[known], predicted.position_covariance[k, rows[known]]
            distance = nees(error, P)
            nll = negative_log_density(distance, P)
            moving = np.hypot(*(then - now)[known].T) > MOVING * horizon
            parts.append(PredictionErrors(np.full(len(error), horizon), np.hypot(*error.T), nll, distance, moving))
        return PredictionErrors.concatenate(parts)


def _nothing() -> PredictionErrors:
    none = np.empty(0)
    return PredictionErrors(none, none, none, none, np.empty(0, dtype=np.bool_))


@dataclass(frozen=True)
class PredictionFigure:
    """The predictions of one method to one horizon.

    moving    moving objects alone, or all
    error     mean, m; change: relative to the reference, None for itself
    nll       mean
    coverage  shares of the errors inside the 50 and 90 % ellipses
    """

    moving: bool
    horizon: float
    method: str
    predictions: int
    error: float
    change: Interval | None
    nll: float
    coverage: dict[float, float]


def prediction_figures(
    methods: Mapping[str, Sequence[PredictionErrors]], reference: str, units: Sequence[Sequence[int]], seed: int = 0
) -> list[PredictionFigure]:
    """Figures of the errors, scene by scene, of each method.

    units  numbers of the scenes; those of one unit are drawn together for the intervals of changes, see `FEWEST_UNITS`
    """
    figures = []
    for moving, horizon in product((False, True), HORIZONS):
        for name, scenes in methods.items():
            mine, base = (_chosen(errors, horizon, moving) for errors in (scenes, methods[reference]))
            every = PredictionErrors.concatenate([_nothing(), *mine])
            if len(every) == 0:
                continue
            change = _change(mine, base, units, seed) if name != reference else None
            error, nll = float(every.error.mean()), float(every.nll.mean())
            shares = coverages(every.nees, (0.5, 0.9))
            figures.append(PredictionFigure(moving, horizon, name, len(every), error, change, nll, shares))
    return figures


def _change(
    mine: Sequence[PredictionErrors], base: Sequence[PredictionErrors], units: Sequence[Sequence[int]], seed: int
) -> Interval:
    """Relative change of the mean error; its bounds are NaN for fewer than `FEWEST_UNITS` units."""
    a, b = (
        [(sum(errors[row].error.sum() for row in unit), sum(len(errors[row]) for row in unit)) for unit in units]
        for errors in (mine, base)
    )
    found = paired_bootstrap(a, b, ratio_of_sums, seed=seed)
    return found if len(units) >= FEWEST_UNITS else replace(found, low=math.nan, high=math.nan)


def _chosen(scenes: Sequence[PredictionErrors], horizon: float, moving: bool) -> list[PredictionErrors]:
    return [e.select((e.horizon == horizon) & (e.moving | (not moving))) for e in scenes]
