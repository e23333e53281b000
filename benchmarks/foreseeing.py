"""A tracker that knows how drivers drive: its predictions of vehicles are a floor for those of any model of them.

It tracks as the one it is made from, so that it starts from the same estimates, and asks the simulator for the rest
(`benchmarks.foresight`): what is left is the error of the estimates, carried on, and what differs from driver
to driver and from moment to moment.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.foresight import foreseen
from benchmarks.predictions import own_tracks
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.world import World
from pipelines.tracking import OnlineTracker
from saga_fg.model.interactions import unit
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame
from saga_fg.types.track import Tracks

PRESENT = 0.5  # s after the latest frame, up to which tracks are of the present and not predictions


class Foreseeing:
    """`tracker` with foresight in a world whose time is that of the frames less `offset`, s."""

    def __init__(self, tracker: OnlineTracker, world: World, settings: SimulatorSettings, offset: float) -> None:
        self._tracker, self._world, self._settings, self._offset = tracker, world, settings, offset
        self._latest = -np.inf
        self._now: Tracks | None = None
        ids = world.objects.id.tolist()
        self._rows = [k for k, name in enumerate(ids) if name.startswith("vehicle-")]
        self._number = [int(ids[k].partition("-")[2]) for k in self._rows]

    def step(self, frame: Frame) -> Tracks:
        """Take in one frame."""
        self._latest = frame.timestamp
        return self._tracker.step(frame)

    def tracks(self, timestamp: float) -> Tracks:
        """The tracks at `timestamp`; later ones from those of the present that were asked for last."""
        found = self._tracker.tracks(timestamp)
        if timestamp <= self._latest + PRESENT or self._now is None:
            self._now = found
            return found
        truth, then = (self._vehicles(moment) for moment in (self._now.timestamp, timestamp))
        number, own = self._number, own_tracks(self._now, truth)
        u = unit(truth.yaw)
        believed, aside = {}, {}
        for k in np.flatnonzero(own >= 0).tolist():
            at = int(np.flatnonzero(self._now.id == own[k])[0])
            error = self._now.boxes.position[at, :2] - truth.position[k, :2]
            believed[number[k]] = float(error @ u[k]), float(self._now.boxes.velocity[at] @ u[k])
            aside[k] = float(u[k, 0] * error[1] - u[k, 1] * error[0])
        now = self._now.timestamp
        ahead = foreseen(self._world, self._settings, now - self._offset, timestamp - now, believed)
        position = found.boxes.position.copy()
        later = unit(then.yaw)
        for k, lateral in aside.items():
            place = then.position[k, :2] + ahead[number[k]] * later[k] + lateral * np.array([-later[k, 1], later[k, 0]])
            position[found.id == own[k], :2] = place
        return replace(found, boxes=replace(found.boxes, position=position))

    def _vehicles(self, timestamp: float) -> Boxes:
        return self._world.objects.at(timestamp - self._offset)[0].select(self._rows)
