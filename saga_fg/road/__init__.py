"""The road as part of the scene graph: lights, stop lines and lanes of a map, cones, and how traffic heeds them."""

from saga_fg.road.cone_geometry import ConeGeometry
from saga_fg.road.road_map import Lane, RoadMap, StopLine, TrafficLight, Wall
from saga_fg.road.signal import COLOURS, SIGHTINGS, SignalSettings, colour_updated

__all__ = [
    "COLOURS",
    "SIGHTINGS",
    "ConeGeometry",
    "Lane",
    "RoadMap",
    "SignalSettings",
    "StopLine",
    "TrafficLight",
    "Wall",
    "colour_updated",
]
