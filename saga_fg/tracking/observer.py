"""Watching a tracker at work: what it knows at the end of each stage of a frame.

A tracker without an observer pays nothing for the possibility; an observer that does not look pays for the call alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from saga_fg.graph import SceneFactorGraph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import Matching
from saga_fg.tracking.columns import TrackColumns
from saga_fg.tracking.observation import Observed
from saga_fg.types.boxes import Boxes

Stage = Literal["predict", "observe", "associate", "update", "believe", "births", "deaths", "report"]


@dataclass(frozen=True, eq=False)
class TrackerView:
    """What a tracker knows of its n tracks, in order of birth.

    timestamp   s, of the state
    sensor      that the frame is of
    columns     existence, score, times and so on
    nodes       as edge rules see them: the tracks, then the nodes of the roadside; positions are local, see `origin`
    P           (n, 2, 2) covariance of the positions, m^2
    origin      (2,) of the local positions in the world, m
    graph       of the latest interval, None before the first
    observed    the frame's detections, from the stage `observe` on
    matching    rows of tracks and of detections, from the stage `associate` on
    born        (b,) rows of the detections that the last b tracks were born from, at the stage `births`
    boxes       of the tracks, in the world
    running     the running graph, where factor providers take part; its positions are local
    """

    timestamp: float
    sensor: str
    columns: TrackColumns
    nodes: NodeTable
    P: FloatArray
    origin: FloatArray
    graph: SceneGraph | None
    observed: Observed | None
    matching: Matching | None
    born: IntArray
    boxes: Boxes
    running: SceneFactorGraph | None

    def places(self) -> FloatArray:
        """(n, 2) positions of the tracks in the world, m."""
        return np.asarray(self.nodes.position[: len(self.columns.id)] + self.origin)


class Observer(Protocol):
    """Whatever wants to know how a tracker comes to its tracks."""

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """A stage of a frame is done; `view()` says how things stand, now and not later."""
        ...
