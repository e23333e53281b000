"""What the bound of `BoundedKalmanFilter` costs in accuracy and saves in time, against the exact filter.

On the connected flock of `pipelines.bench.flocks`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pipelines.bench.flocks import NEIGHBOURS, Flock, Frame, flock
from pipelines.bench.measuring import timed
from pipelines.process import one_thread
from saga_fg.estimators import BoundedKalmanFilter, Estimator, JointKalmanFilter
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import Range, Settings, setting


@dataclass(frozen=True)
class BoundedBenchSettings(Settings):
    """How much is measured."""

    nodes: Annotated[int, Range(NEIGHBOURS + 1, 10**6)] = setting(1000, "nodes of the flock")
    frames: Annotated[int, Range(1, 10**6)] = setting(10, "frames that are counted")
    warm_up: Annotated[int, Range(0, 10**6)] = setting(5, "frames before them")
    hops: tuple[int, ...] = setting((1, 2, 3), "bounds to compare")
    mixing: Annotated[float, Range(0, 0.99)] = setting(
        0.35, "share of its velocity that a node takes over from its neighbours in a frame"
    )
    seed: int = setting(0, "seed of the flock")


@dataclass(frozen=True)
class BoundedRow:
    """One bound.

    milliseconds  median a frame, and ratio to that of the exact filter
    mean_error    of the means against the exact ones, mean over nodes, components and frames, standard deviations;
                  worst_error: the largest
    anees         mean of e^T P^-1 e / d against the truth, and anees_ratio to that of the exact filter
    likelihood_error  largest difference of a frame's log-likelihood, per measured value
    nodes_per_cluster with its halo
    """

    hops: int
    milliseconds: float
    ratio: float
    mean_error: float
    worst_error: float
    anees: float
    anees_ratio: float
    likelihood_error: float
    nodes_per_cluster: float


def bench_bounded(settings: BoundedBenchSettings) -> tuple[BoundedRow, ...]:
    """A row for each bound; the exact filter and the bounded ones take turns frame by frame."""
    frames = settings.warm_up + settings.frames
    scene = flock("connected", settings.nodes, frames, settings.seed, settings.mixing)
    exact = _Taken(JointKalmanFilter(), scene)
    bounded = {hops: _Taken(BoundedKalmanFilter(hops=hops), scene) for hops in settings.hops}
    with one_thread():
        for k, frame in enumerate(scene.frames):
            counted = k >= settings.warm_up
            exact.take(frame, counted)
            for taken in bounded.values():
                taken.take(frame, counted, exact)
    return tuple(_row(hops, taken, exact) for hops, taken in bounded.items())


class _Taken:
    """A filter that takes frames in, and what was measured of it."""

    def __init__(self, estimator: Estimator, scene: Flock) -> None:
        self.estimator, self._nodes = estimator, scene.nodes
        estimator.add(scene.nodes, scene.means, scene.covariances)
        self.times: list[float] = []
        self.errors: list[FloatArray] = []
        self.squares: list[float] = []
        self.likelihoods: list[float] = []

    def take(self, frame: Frame, counted: bool, exact: _Taken | None = None) -> None:
        milliseconds = timed(lambda: self._step(frame))
        if not counted:
            return
        self.times.append(milliseconds)
        error = (frame.truth - self.means)[:, :, None]
        square = np.swapaxes(error, 1, 2) @ np.linalg.solve(self.covariances, error)
        self.squares.append(float(square.mean() / error.shape[1]))
        if exact is not None:
            sigma = np.sqrt(np.diagonal(exact.covariances, axis1=1, axis2=2))
            self.errors.append(np.abs(self.means - exact.means) / sigma)
            self.likelihoods.append((self.likelihood - exact.likelihood) / frame.measurements.z.size)

    def _step(self, frame: Frame) -> None:
        self.estimator.predict(frame.transition)
        self.likelihood = self.estimator.update(frame.measurements)
        self.means, self.covariances = self.estimator.mean(self._nodes), self.estimator.covariance(self._nodes)


def _row(hops: int, taken: _Taken, exact: _Taken) -> BoundedRow:
    assert isinstance(taken.estimator, BoundedKalmanFilter)
    milliseconds, anees = float(np.median(taken.times)), float(np.mean(taken.squares))
    errors = np.array(taken.errors)
    return BoundedRow(
        hops,
        milliseconds,
        float(np.median(np.array(taken.times) / np.array(exact.times))),
        float(errors.mean()),
        float(errors.max()),
        anees,
        anees / float(np.mean(exact.squares)),
        float(np.abs(taken.likelihoods).max()),
        float(np.mean([len(cluster) for cluster in taken.estimator.clusters])),
    )
