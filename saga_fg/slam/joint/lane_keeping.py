"""Factor provider of the lanes of a map, which vehicles keep; see `saga_fg.slam.joint.lanes`.

Online, a vehicle is assigned to its lane when the moment comes, and stays so while the moment is in the window. A lane
that nobody keeps any more leaves with the last who did; met again, it is one of which the map alone is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from saga_fg.graph import MAP_NODE, Additions, GraphView, NewVariable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint.estimate import JointEstimate
from saga_fg.slam.joint.graph import Keyed
from saga_fg.slam.joint.lanes import Keeping, KnownLane, keepings, known_lanes, lane_factors, lane_key, lane_priors
from saga_fg.slam.joint.settings import LaneSettings
from saga_fg.types.road_map import RoadMap


class LaneKeeping:
    """The lanes of the maps so far, and who keeps them."""

    name = "lanes"

    def __init__(self, settings: LaneSettings | None, maps: Iterable[RoadMap | None]) -> None:
        self._settings = settings
        self._maps: list[RoadMap] = []
        self._lanes: list[KnownLane] = []
        self._record: Keyed = []
        self._found: list[Keeping] = []
        self._kept: list[Keeping] = []
        self.learn(*maps)

    @property
    def rounds(self) -> int:
        """How often vehicles are to be assigned anew; 0 without lanes."""
        return 0 if self._settings is None or not self._lanes else self._settings.rounds

    def learn(self, *maps: RoadMap | None) -> None:
        """Take in maps that frames bring along; most bring the same."""
        for one in maps:
            if one is not None and all(one is not known for known in self._maps):
                self._maps.append(one)
                self._lanes = known_lanes(self._maps)

    def assign(self, record: Keyed, estimate: JointEstimate, standing: Sequence[FloatArray]) -> bool:
        """Assign the vehicles of the last moments of a record to lanes; whether any is assigned.

        estimate, standing: what is known of these moments, and the probabilities (n,) that their objects stand
        """
        self._record, self._found, self._first = record, [], record[-len(estimate.objects)][0]
        if self.rounds and self._settings is not None:
            for row in range(-len(estimate.objects), 0):
                k, moment = record[row]
                pose = estimate.world_T_ego[row], estimate.pose_covariances[row]
                objects = estimate.objects[row]
                self._found += keepings(k, objects, moment.seen.id, standing[row], pose, self._lanes, self._settings)
        self._kept += self._found
        return bool(self._found)

    def factors(self, view: GraphView) -> Additions:
        """Lanes that are new to the graph, and the vehicles that keep one, as last assigned."""
        if self._settings is None:
            return Additions()
        met = {one.lane for one in self._found}
        new = [one for one in self._lanes if one.number in met and lane_key(one.number) not in view.variables]
        lanes = [NewVariable(MAP_NODE, lane.number, np.zeros(1), static=True, label="lane") for lane in new]
        kept_lanes = lane_factors(self._record, self._found, self._settings)
        return Additions(lanes, lane_priors(new), {self._first: kept_lanes})

    def leave(self, first: int) -> list[int]:
        """Forget who kept a lane before the moment `first`; returns the keys of lanes that nobody keeps any more."""
        before = {one.lane for one in self._kept}
        self._kept = [one for one in self._kept if one.moment >= first]
        return [lane_key(number) for number in before - {one.lane for one in self._kept}]
