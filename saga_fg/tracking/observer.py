"""Observing a tracker at work: the state and the results at the end of each step of a frame.

A tracker without an observer pays nothing for the possibility; a view is made only for an observer that asks for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from saga_fg.graph import SceneFactorGraph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.assignment import Matching
from saga_fg.tracking.clock import Clock
from saga_fg.tracking.clock_offsets import SensorTime, SharedObservations, sensor_times
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.prediction import node_table
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types.boxes import Boxes

Stage = Literal["predict", "measure", "associate", "update", "existence", "initiate", "delete", "report"]


@dataclass(frozen=True, eq=False)
class TrackerView:
    """A tracker with n tracks at the end of a stage.

    timestamp     s, of the state
    sensor        of the frame
    table         the tracks, with times in s as timestamps are
    nodes         as edge rules see them: the tracks, the vehicle, the map; positions are local, see `origin`
    P             (n, 2, 2) covariance of the positions, m^2
    origin        (2,) of the local positions in the world, m
    graph         scene graph of the latest interval, None before the first
    measurements  of the frame, from the stage `measure` on
    matching      rows of tracks and of measurements, from the stage `associate` on
    initiated     (b,) rows of the measurements that initiated the last b tracks, at the stage `initiate`
    boxes         of the tracks, in the world
    clock, shared of the sensors, and what their frames have in common, see `clocks`
    settled       (n,) tracks for which the solver has found the minimum of the graph
    running       the running graph, where factor providers take part; its positions are local
    """

    timestamp: float
    sensor: str
    table: TrackTable
    nodes: NodeTable
    P: FloatArray
    origin: FloatArray
    graph: SceneGraph | None
    measurements: FrameMeasurements | None
    matching: Matching | None
    initiated: IntArray
    boxes: Boxes
    clock: Clock
    shared: SharedObservations
    settled: BoolArray
    running: SceneFactorGraph | None

    @classmethod
    def of(
        cls,
        state: TrackerState,
        sensor: str,
        measurements: FrameMeasurements | None = None,
        matching: Matching | None = None,
        initiated: IntArray | None = None,
    ) -> TrackerView:
        """View a state and the results of a frame so far."""
        table, now = state.table.snapshot(), state.kinematics()
        table.last_detected += state.start
        table.last_in_view += state.start
        return cls(
            state.start + state.time,
            sensor,
            table,
            node_table(state),
            now.P,
            state.origin,
            state.graph,
            measurements,
            matching,
            np.empty(0, dtype=np.int64) if initiated is None else initiated,
            replace(state.boxes(now.position, now.velocity)),
            state.clock,
            state.shared,
            state.joint.settled(table.id),
            state.joint.estimator.graph() if state.providers else None,
        )

    @property
    def clocks(self) -> dict[str, SensorTime]:
        """The clocks of the sensors, where there are several."""
        return sensor_times(self.clock, self.shared) if len(self.clock.sensors) > 1 else {}

    def positions(self) -> FloatArray:
        """(n, 2) positions of the tracks in the world, m."""
        return np.asarray(self.nodes.position[: len(self.table)] + self.origin)


class Observer(Protocol):
    """Anything that observes how a tracker comes to its tracks."""

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Take note of a stage; `view()` returns the tracker's view and is valid during this call only."""
        ...
