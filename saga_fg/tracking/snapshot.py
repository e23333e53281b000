"""What a tracker knows besides its joint state, and all that it knows at one moment, as a value."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.assignment import Assignment
from saga_fg.tracking.box_filter import BoxFilter
from saga_fg.tracking.clock import Clock, TimeVerdict
from saga_fg.tracking.columns import TrackColumns
from saga_fg.tracking.ego_node import EgoNode
from saga_fg.tracking.roadside import Roadside
from saga_fg.tracking.sensor_evidence import SensorEvidence
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.standing import Standing
from saga_fg.tracking.traffic_flow import TrafficFlow

Table = TypeVar("Table")


@dataclass(eq=False)
class TrackTables:
    """What is kept of n tracks, road and vehicle besides the joint state; belief (n, C) of the tracks' classes."""

    columns: TrackColumns
    box: BoxFilter
    evidence: SensorEvidence
    standing: Standing
    belief: FloatArray
    flow: TrafficFlow
    roadside: Roadside
    ego: EgoNode

    @classmethod
    def empty(cls, settings: TrackerSettings, classes: int) -> TrackTables:
        """Of no tracks; `classes`: C."""
        return cls(
            TrackColumns.empty(),
            BoxFilter.empty(),
            SensorEvidence.empty(),
            Standing.empty(),
            np.empty((0, classes)),
            TrafficFlow(settings.traffic_flow_prior),
            Roadside(settings.signals),
            EgoNode.of(settings),
        )

    def keep(self, rows: BoolArray) -> None:
        """Keep these tracks (n,)."""
        self.columns, self.box = self.columns.select(rows), self.box.select(rows)
        self.standing, self.belief = self.standing.select(rows), self.belief[rows]
        self.evidence.select(rows)

    def copied(self) -> TrackTables:
        """Tables that can be changed without a change to these."""
        return TrackTables(*(_copied(table) for table in vars(self).values()))


@dataclass(frozen=True, eq=False)
class TrackSetState:
    """A `TrackSet` at one moment.

    state        of the estimator
    tables       of the tracks
    start, time  from which times are counted, s; of the state, from there
    origin       (2,) of local positions in the world, m
    next_id      of the next new track
    graph        of the latest interval
    """

    state: Any
    tables: TrackTables
    start: float
    time: float
    origin: FloatArray
    next_id: int
    graph: SceneGraph | None


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A tracker at one moment: its tracks, its clock, frames that came late so far, what became of the latest frame."""

    tracks: TrackSetState
    clock: Clock
    time_verdict: TimeVerdict
    late_frames: int
    assignment: Assignment


def _copied(table: Table) -> Table:
    """With arrays of its own; all else in it is never changed in place."""
    twin = copy.copy(table)
    for name, value in getattr(table, "__dict__", {}).items():
        if isinstance(value, np.ndarray):
            setattr(twin, name, value.copy())
    return twin
