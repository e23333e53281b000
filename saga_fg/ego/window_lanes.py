"""Lanes of an online estimator's window, which vehicles keep; see `saga_fg.ego.lanes`.

A vehicle is assigned to its lane when the moment comes, and stays so while the moment is in the window. A lane that
nobody keeps any more leaves with the last who did; met again, it is one of which the map alone is known.
"""

from __future__ import annotations

import numpy as np

from saga_fg.arrays import FloatArray
from saga_fg.ego.estimate import read_estimate
from saga_fg.ego.graph import Keyed
from saga_fg.ego.lanes import Keeping, KnownLane, keepings, known_lanes, lane_factors, lane_key, lane_priors
from saga_fg.ego.settings import LaneSettings
from saga_fg.estimators.graph_solution import GraphSolution
from saga_fg.graph import MAP_NODE, Additions, GraphView, NewVariable
from saga_fg.road.road_map import RoadMap


class WindowLanes:
    """The lanes of the maps so far, and who keeps them."""

    name = "lanes"

    def __init__(self, settings: LaneSettings | None, road_map: RoadMap | None) -> None:
        self._settings = settings
        self._new = Additions()
        self._maps = [road_map]
        self._lanes: list[KnownLane] = known_lanes(self._maps)
        self._kept: list[Keeping] = []

    def learn(self, road_map: RoadMap | None) -> None:
        """Take in a map that a frame brings along; most bring the same."""
        if road_map is not None and all(road_map is not known for known in self._maps):
            self._maps.append(road_map)
            self._lanes = known_lanes(self._maps)

    def factors(self, view: GraphView) -> Additions:
        """Lanes that are new in the window, and the vehicles of the newest moment that keep one, as last assigned."""
        return self._new

    def keep(self, record: Keyed, solution: GraphSolution, standing: FloatArray) -> bool:
        """Assign the vehicles of the newest moment, which stand with these probabilities, to lanes; whether any is."""
        if self._settings is None or not self._lanes:
            return False
        newest, (k, moment) = read_estimate(record[-1:], solution), record[-1]
        pose = newest.world_T_ego[-1], newest.pose_covariances[-1]
        found = keepings(k, newest.objects[-1], moment.seen.id, standing, pose, self._lanes, self._settings)
        there = {one.lane for one in self._kept}
        fresh = [lane for lane in self._lanes if lane.number in {one.lane for one in found} - there]
        lanes = [NewVariable(MAP_NODE, lane.number, np.zeros(1), static=True, label="lane") for lane in fresh]
        self._kept += found
        self._new = Additions(lanes, [*lane_priors(fresh), *lane_factors(record, found, self._settings)])
        return bool(found)

    def leave(self, first: int) -> list[int]:
        """Forget who kept a lane before the moment `first`; returns the keys of lanes that nobody keeps any more."""
        before = {one.lane for one in self._kept}
        self._kept = [one for one in self._kept if one.moment >= first]
        return [lane_key(number) for number in before - {one.lane for one in self._kept}]
