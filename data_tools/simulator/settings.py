"""Settings of the traffic simulator, and named scenarios.

Scenarios:

traffic      the default settings
red-light    a queue before a traffic light; frames have a map, the camera reports colours
road-works   cones close the right lane and move its traffic into the adjacent lane; the map does not have the cones
merge        the same, seen from a mast; some drivers let nobody in
towing       many trucks, most of them with a trailer
two-sensors  a LiDAR with few points on far and small objects, and with outages; cameras that see far ahead
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from saga_fg.errors import InputError
from saga_fg.settings import (
    Finite,
    Fraction,
    NonNegative,
    Positive,
    PositiveOrInf,
    Range,
    Settings,
    setting,
    settings_group,
)

NonNegativeSpan = Annotated[tuple[float, float], Range(0, ascending=True)]
Count = Annotated[tuple[int, int], Range(0, ascending=True)]  # fewest and most
PositiveCount = Annotated[tuple[int, int], Range(0, above=True, ascending=True)]
VAN_SHARE = 0.25  # of the vehicles; vans are labelled car and high enough to hide cars
HIDDEN_SHARE = 0.15  # visible share up to which an object is never detected
CLEAR_SHARE = 0.35  # visible share from which occlusion has no effect


@dataclass(frozen=True)
class TrafficSettings(Settings):
    """Vehicles: kinds, platoons, and disturbances of the traffic flow."""

    truck_share: Fraction = setting(0.18, "share of trucks")
    bus_share: Fraction = setting(0.08, "share of buses")
    trailer_share: Fraction = setting(0.0, "share of the trucks that tow a trailer")
    platoon_size: PositiveCount = setting((3, 9), "fewest and most vehicles in a platoon")
    platoon_gap: NonNegativeSpan = setting((10.0, 60.0), "extra distance between platoons, m")
    takers: Fraction = setting(0.0, "share of drivers who speed up where a lane ends, and let nobody in")
    signal_probability: Fraction = setting(0.7, "share of scenes with a traffic light; the others have a slow zone")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not VAN_SHARE + self.truck_share + self.bus_share <= 1:
            raise InputError(
                f"truck_share and bus_share: expected at most {1 - VAN_SHARE:g} together, the rest are vans and cars"
            )


@dataclass(frozen=True)
class SensorSettings(Settings):
    """One sensor with its detector. Noise is independent between frames and between the range and bearing axes.

    The probability of detection is detection_probability * ramp(visible share) / (1 + exp((range - reach) / FADING)),
    the ramp rising from 0 at HIDDEN_SHARE to 1 at CLEAR_SHARE. With a `resolution` the last factor is
    n^2 / (n^2 + enough_points^2), n the points or pixels on the visible part of the object.
    """

    rate: Positive = setting(10.0, "frames per second, 1/s")
    offset: Finite = setting(0.0, "time of the first frame after the start of the scene, s")
    field_of_view: Annotated[float, Range(0, 2 * math.pi + 1e-9, above=True)] = setting(
        2 * math.pi, "horizontal field of view, centred straight ahead, rad"
    )
    position: tuple[float, float, float] = setting((0.94, 0.0, 1.84), "mounting position on the vehicle (x, y, z), m")
    max_range: Positive = setting(60.0, "largest range of a detection, m")
    range_noise: Annotated[tuple[float, float], Range(0)] = setting(
        (0.10, 0.002), "range error: standard deviation at 0 m, and per m"
    )
    bearing_noise: Annotated[tuple[float, float], Range(0)] = setting(
        (0.08, 0.002), "error across the line of sight: standard deviation at 0 m, m, and per m, rad"
    )
    height_noise: NonNegative = setting(0.08, "standard deviation of the elevation, m")
    size_noise: NonNegative = setting(0.05, "relative standard deviation of length, width, height")
    yaw_noise: NonNegative = setting(0.05, "standard deviation of the heading, rad")
    velocity_noise: Positive | None = setting(
        None, "standard deviation of each velocity component, m/s; null: no velocity"
    )
    range_rate_noise: Positive | None = setting(
        None, "standard deviation of the range rate over ground, m/s; null: no range rate"
    )
    boxes: bool = setting(True, "measure sizes and headings")
    class_accuracy: Fraction = setting(
        1.0, "probability that a car, truck or bus is reported as such; otherwise as one of the others"
    )
    colour_accuracy: Fraction | None = setting(
        None, "probability that the colour of a traffic light is reported correctly; null: lights are not detected"
    )
    detection_probability: Fraction = setting(0.97, "probability of detection of a fully visible object at close range")
    reach: Positive = setting(60.0, "range at which the probability of detection has halved, m")
    resolution: Annotated[tuple[float, float], Range(0, above=True)] | None = setting(
        None,
        "horizontal and vertical angle between points or pixels, rad; null: an object's size does not matter",
    )
    enough_points: Positive = setting(5.0, "points or pixels on an object that halve the probability of detection")
    range_drift: NonNegative = setting(
        0.0, "standard deviation of a relative error of the range that changes slowly, as of a camera; 0: none"
    )
    outage_interval: PositiveOrInf = setting(math.inf, "mean time from one outage of the sensor to the next, s")
    clutter_rate: NonNegative = setting(2.0, "mean number of false detections a frame")
    true_logit: Finite = setting(2.0, "mean logit of the score of a fully visible object at close range")
    clutter_logit: Finite = setting(-1.5, "mean logit of the score of a false detection")
    logit_noise: NonNegative = setting(0.8, "standard deviation of the logit of the score")


def lidar() -> SensorSettings:
    """A LiDAR on the roof with a full horizontal field of view."""
    return SensorSettings()


def camera() -> SensorSettings:
    """A front camera: good bearings, poor ranges, noisy velocities, an own frame rate."""
    return SensorSettings(
        rate=12.0,
        offset=0.031,
        field_of_view=math.radians(120),
        position=(1.7, 0.0, 1.5),
        max_range=50.0,
        range_noise=(0.2, 0.03),
        bearing_noise=(0.08, 0.004),
        height_noise=0.15,
        size_noise=0.1,
        yaw_noise=0.15,
        velocity_noise=1.0,
        detection_probability=0.88,
        reach=45.0,
        clutter_rate=3.0,
        true_logit=1.2,
        clutter_logit=-1.2,
        logit_noise=1.0,
    )


def sparse_lidar() -> SensorSettings:
    """A LiDAR of 32 beams: few points on far and on small objects, and outages by spray and lost packets."""
    return SensorSettings(
        max_range=70.0,
        resolution=(0.0058, 0.0232),
        enough_points=5.0,
        outage_interval=10.0,
    )


def far_camera() -> SensorSettings:
    """Front cameras of 1600 pixels each 70 degrees: far and small objects, at ranges that drift by some per cent."""
    return replace(
        camera(),
        max_range=100.0,
        resolution=(8e-4, 8e-4),
        enough_points=250.0,
        range_noise=(0.2, 0.02),
        range_drift=0.02,
        true_logit=1.8,
    )


def radar() -> SensorSettings:
    """A front radar: good ranges, poor bearings, the range rate over ground; neither sizes nor headings."""
    return SensorSettings(
        rate=14.0,
        offset=0.017,
        field_of_view=math.radians(120),
        position=(3.6, 0.0, 0.5),
        max_range=60.0,
        range_noise=(0.3, 0.002),
        bearing_noise=(0.3, 0.015),
        height_noise=0.5,
        range_rate_noise=0.15,
        boxes=False,
        detection_probability=0.85,
        clutter_rate=4.0,
        true_logit=1.0,
        clutter_logit=-1.0,
        logit_noise=1.0,
    )


@dataclass(frozen=True)
class SimulatorSettings(Settings):
    """All settings of simulated scenes."""

    duration: Positive = setting(20.0, "length of a scene, s")
    keyframe_rate: Positive = setting(10.0, "rate of ground truth and of track output, 1/s")
    warm_up: NonNegative = setting(15.0, "time simulated before the scene starts, s")
    annotation_range: PositiveOrInf = setting(
        60.0, "distance from the ego vehicle within which objects are annotated, m"
    )
    shortest_view: NonNegative = setting(1.0, "shortest view that counts as visible, s")
    memory: Annotated[float, Range(0, infinite=True)] = setting(
        4.0, "duration for which a hidden object stays annotated after it was last visible, s; .inf: all are annotated"
    )
    lanes: PositiveCount = setting((2, 4), "fewest and most lanes in the ego vehicle's direction; traffic keeps right")
    oncoming_lanes: PositiveCount = setting((1, 3), "fewest and most lanes in the other direction")
    merge_probability: Fraction = setting(0.3, "share of scenes with a lane that ends (an on-ramp or a lane drop)")
    roadworks_probability: Fraction = setting(
        0.0, "share of these whose lane is closed by cones: a taper that moves its traffic aside, then a row along it"
    )
    parking_probability: Fraction = setting(0.35, "share of roadsides with a strip of parked cars")
    pedestrian_groups: Count = setting((3, 8), "fewest and most groups of pedestrians within reach of the ego vehicle")
    mast: bool = setting(False, "the sensors are on a mast beside the place where a lane ends, not on a vehicle")
    mapped: bool = setting(False, "give frames a map of traffic lights, stop lines and lanes")
    traffic: TrafficSettings = settings_group(TrafficSettings, "vehicles")
    sensors: dict[str, SensorSettings] = settings_group(
        lambda: {"lidar": lidar(), "camera": camera()}, "sensors on the ego vehicle, by name"
    )


ScenarioName = Literal["traffic", "red-light", "road-works", "merge", "towing", "two-sensors"]


_SETTINGS: Mapping[ScenarioName, SimulatorSettings] = {
    "traffic": SimulatorSettings(),
    "red-light": SimulatorSettings(
        merge_probability=0.0,
        traffic=TrafficSettings(signal_probability=1.0),
        mapped=True,
        sensors={"lidar": lidar(), "camera": replace(camera(), colour_accuracy=0.9)},
    ),
    "road-works": SimulatorSettings(
        lanes=(1, 1),
        merge_probability=1.0,
        traffic=TrafficSettings(platoon_size=(2, 5), platoon_gap=(15.0, 60.0)),  # light: one lane less makes no jam
        roadworks_probability=1.0,
        mapped=True,
    ),
    "merge": SimulatorSettings(
        duration=20.0,
        warm_up=3.0,
        annotation_range=80.0,
        lanes=(1, 1),
        oncoming_lanes=(1, 1),
        merge_probability=1.0,
        roadworks_probability=1.0,
        parking_probability=0.0,
        pedestrian_groups=(0, 0),
        mast=True,
        traffic=TrafficSettings(takers=0.6, truck_share=0.08, bus_share=0.02, platoon_gap=(3.0, 20.0)),
        sensors={"lidar": replace(lidar(), position=(0.0, 0.0, 7.0), max_range=80.0, reach=90.0, clutter_rate=1.0)},
    ),
    "towing": SimulatorSettings(traffic=TrafficSettings(truck_share=0.35, bus_share=0.02, trailer_share=0.8)),
    "two-sensors": SimulatorSettings(
        keyframe_rate=2.0,
        annotation_range=100.0,
        lanes=(1, 3),
        oncoming_lanes=(1, 2),
        traffic=TrafficSettings(platoon_size=(1, 4), platoon_gap=(20.0, 80.0)),  # light, with views far ahead
        parking_probability=0.15,
        pedestrian_groups=(6, 12),
        sensors={"sparse_lidar": sparse_lidar(), "far_camera": far_camera()},
    ),
}


def scenario_settings(name: ScenarioName) -> SimulatorSettings:
    """The settings of a scenario."""
    return _SETTINGS[name]
