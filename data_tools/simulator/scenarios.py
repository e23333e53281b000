"""Named scenarios, as settings of the simulator.

traffic      the default settings
red-light    a queue before a traffic light; frames have a map, the camera reports colours
road-works   cones close the right lane and move its traffic into the adjacent lane; the map does not have the cones
towing       many trucks, most of them with a trailer
cycling      cyclists beside slow traffic
two-sensors  a LiDAR with few points on far and small objects, and with outages; cameras that see far ahead
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, get_args

from data_tools.simulator.settings import (
    CyclistSettings,
    LightSettings,
    PedestrianSettings,
    RoadSettings,
    RoadworkSettings,
    SimulatorSettings,
    SurroundingSettings,
    TrafficSettings,
    camera,
    far_camera,
    lidar,
    sparse_lidar,
)

ScenarioName = Literal["traffic", "red-light", "road-works", "towing", "cycling", "two-sensors"]
SCENARIOS: tuple[ScenarioName, ...] = get_args(ScenarioName)


_SETTINGS: Mapping[ScenarioName, SimulatorSettings] = {
    "traffic": SimulatorSettings(),
    "red-light": SimulatorSettings(
        road=RoadSettings(merge_probability=0.0),
        traffic=TrafficSettings(signal_probability=1.0),
        lights=LightSettings(mapped=True),
        sensors={"lidar": lidar(), "camera": replace(camera(), colour_accuracy=0.9)},
    ),
    "road-works": SimulatorSettings(
        road=RoadSettings(lanes=(1, 1), merge_probability=1.0),
        traffic=TrafficSettings(platoon_size=(2, 5), platoon_gap=(15.0, 60.0)),  # light: one lane less makes no jam
        roadworks=RoadworkSettings(probability=1.0),
        lights=LightSettings(mapped=True),
    ),
    "towing": SimulatorSettings(traffic=TrafficSettings(truck_share=0.35, bus_share=0.02, trailer_share=0.8)),
    "cycling": SimulatorSettings(cyclists=CyclistSettings(count=(5, 9))),
    "two-sensors": SimulatorSettings(
        keyframe_rate=2.0,
        annotation_range=100.0,
        road=RoadSettings(lanes=(1, 3), oncoming_lanes=(1, 2)),
        traffic=TrafficSettings(platoon_size=(1, 4), platoon_gap=(20.0, 80.0)),  # light, with views far ahead
        surroundings=SurroundingSettings(parking_probability=0.15),
        pedestrians=PedestrianSettings(groups=(6, 12)),
        sensors={"sparse_lidar": sparse_lidar(), "far_camera": far_camera()},
    ),
}


def scenario_settings(name: ScenarioName) -> SimulatorSettings:
    """The settings of a scenario."""
    return _SETTINGS[name]
