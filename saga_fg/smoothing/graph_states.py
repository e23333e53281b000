"""A recording as a running graph, in which factors of users' own take part.

Objects are variables by id and moment, with the new objects, interactions and detections of the smoother in NumPy, and
start at its result, the states without the users' factors. `BatchSolver` solves everything at once.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.estimators import BatchSolver, DetectionFactors, Interactions, Measurements, NewObjects
from saga_fg.graph import OBJECT, Additions, FactorProvider, GraphView, key_of
from saga_fg.model.transition import Transition
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.states import StateTable

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class RecordingEpoch:
    """A moment of the recording: how objects got here, who is new, what is measured, and ids of who goes afterwards."""

    moment: int
    transition: Transition | None
    new_objects: NewObjects
    measurements: Sequence[Measurements]
    gone: IntArray


@dataclass(frozen=True, eq=False)
class _At:
    """A provider whose objects begin at known states, by id."""

    provider: FactorProvider
    states: Mapping[int, FloatArray]

    @property
    def name(self) -> str:
        return self.provider.name

    def factors(self, view: GraphView) -> Additions:
        additions = self.provider.factors(view)
        return replace(additions, variables=[replace(new, state=self.states[new.id]) for new in additions.variables])


def states_in_graph(
    epochs: Sequence[RecordingEpoch],
    start: StateTable,
    evidence: Evidence,
    labels: Mapping[int, str],
    providers: Sequence[FactorProvider],
) -> StateTable:
    """Smoothed states with the users' factors; start: without them; labels of the objects by id.

    Raises `GraphError`, naming the provider, for what the graph does not take.
    """
    solver = BatchSolver()
    solver.origin = evidence.origin
    for epoch in epochs:
        rows = start.at(epoch.moment)
        states = dict(zip(start.id[rows].tolist(), start.mean[rows], strict=True))
        moved = [] if epoch.transition is None else [_At(Interactions(epoch.transition), states)]
        new = _At(replace(epoch.new_objects, labels=labels), states)
        solver.step(
            float(evidence.times[epoch.moment]), [*moved, new, *map(DetectionFactors, epoch.measurements), *providers]
        )
    if not solver.solve().converged:
        log.warning("the states with the factors of %s have not settled", ", ".join(one.name for one in providers))
    number = {epoch.moment: k for k, epoch in enumerate(epochs)}
    keys = [key_of(OBJECT, i, number[k]) for k, i in zip(start.moment.tolist(), start.id.tolist(), strict=True)]
    mean = np.array([solver.state(key) for key in keys]).reshape(start.mean.shape)
    covariance = np.array([solver.covariance(key) for key in keys]).reshape(start.covariance.shape)
    return replace(start, mean=mean, covariance=covariance)
