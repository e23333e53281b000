"""Settings of the traffic simulator. A pair (low, high) is a range from which each scene draws uniformly."""

from __future__ import annotations

import math
from dataclasses import dataclass

from saga_fg.errors import InputError
from saga_fg.settings import require_between, setting, settings_group

Range = tuple[float, float]


def _require_positive(settings: object, *names: str) -> None:
    """Raise `InputError` unless the named settings, numbers or ranges of growing numbers, are above 0."""
    for name in names:
        value = getattr(settings, name)
        is_range = isinstance(value, tuple | list)
        low, high = value if is_range else (value, value)
        if not 0 < low <= high:
            expected = "two growing positive numbers (low, high)" if is_range else "a positive number"
            raise InputError(f"{name}: expected {expected}, got {value}")


def _require_counts(settings: object, *names: str) -> None:
    """Raise `InputError` unless the named settings, each the fewest and the most, are growing numbers from 0 on."""
    for name in names:
        fewest, most = getattr(settings, name)
        if not 0 <= fewest <= most:
            raise InputError(f"{name}: expected two growing numbers >= 0, got {(fewest, most)}")


@dataclass(frozen=True)
class RoadSettings:
    """Shape of the road, in m; traffic keeps to the right."""

    length: float = setting(1000.0, "length of the simulated road, m")
    lane_width: float = setting(3.5, "width of a lane, m")
    lanes: tuple[int, int] = setting((2, 4), "fewest and most lanes in the ego vehicle's direction")
    oncoming_lanes: tuple[int, int] = setting((1, 3), "fewest and most lanes in the other direction")
    curve_probability: float = setting(0.5, "share of scenes on a curved road")
    curve_radius: Range = setting((100.0, 300.0), "smallest radius of a curve's centre line, m")
    merge_probability: float = setting(0.3, "share of scenes with a lane that ends (an on-ramp or a lane drop)")
    median_probability: float = setting(0.5, "share of scenes with a hedge between the directions")
    median_width: float = setting(3.0, "width of the strip that carries the hedge, m")

    def __post_init__(self) -> None:
        _require_positive(self, "lane_width", "lanes", "oncoming_lanes", "curve_radius", "median_width")
        if not self.length >= 800:
            raise InputError(f"length: expected at least 800 m, got {self.length}")


@dataclass(frozen=True)
class DriverSettings:
    """Means of the Intelligent Driver Model's parameters over the drivers of cars, and how much drivers differ."""

    desired_speed: Range = setting((10.0, 16.0), "mean desired speed of a scene's drivers, m/s")
    time_headway: float = setting(1.2, "desired time headway T, s")
    minimum_gap: float = setting(2.0, "gap s0 kept at standstill, m")
    max_acceleration: float = setting(1.5, "maximum acceleration a, m/s^2")
    comfortable_deceleration: float = setting(2.0, "comfortable deceleration b, m/s^2")
    spread: float = setting(0.15, "relative standard deviation of all these over drivers (log-normal)")
    reaction_time: float = setting(0.3, "delay between what a driver sees and what his car does, s")
    acceleration_noise: float = setting(0.2, "standard deviation of random acceleration, m/s^2")
    noise_time: float = setting(3.0, "correlation time of the random acceleration, s")
    politeness: float = setting(0.3, "weight of the new follower's loss in the decision to change lanes")
    change_threshold: float = setting(0.3, "gain in acceleration that is worth a change of lanes, m/s^2")
    safe_deceleration: float = setting(3.0, "hardest braking a lane change may cause, m/s^2")

    def __post_init__(self) -> None:
        _require_positive(self, "desired_speed", "time_headway", "minimum_gap", "max_acceleration")
        _require_positive(self, "comfortable_deceleration", "noise_time")


@dataclass(frozen=True)
class TrafficSettings:
    """How many vehicles there are, of which kinds, and what disturbs their flow."""

    van_share: float = setting(0.25, "share of vans and the like, labelled car, that one cannot look over")
    truck_share: float = setting(0.18, "share of trucks")
    bus_share: float = setting(0.08, "share of buses")
    trailer_share: float = setting(0.0, "share of the trucks that tow a trailer")
    platoon_size: tuple[int, int] = setting((3, 9), "fewest and most vehicles in a platoon")
    platoon_gap: Range = setting((10.0, 60.0), "extra distance between platoons, m")
    signal_probability: float = setting(0.7, "share of scenes with a traffic light ahead; the rest have a slow zone")
    red_duration: Range = setting((8.0, 18.0), "duration of a red phase, s")
    green_duration: Range = setting((8.0, 16.0), "duration of a green phase, s")
    lane_wise_probability: float = setting(0.5, "share of scenes where lanes have lights or slow zones of their own")
    slow_speed: Range = setting((1.0, 4.0), "speed in a slow zone while it is active, m/s")
    slow_duration: Range = setting((5.0, 12.0), "how long a slow zone is active, and inactive, s")

    def __post_init__(self) -> None:
        _require_positive(self, "platoon_size", "red_duration", "green_duration", "slow_speed", "slow_duration")
        if not 0 <= self.trailer_share <= 1:
            raise InputError(f"trailer_share: expected a share in [0, 1], got {self.trailer_share}")
        if not self.van_share + self.truck_share + self.bus_share <= 1:
            raise InputError("van_share: expected the shares of vans, trucks and buses to be at most 1 together")


@dataclass(frozen=True)
class PedestrianSettings:
    """People on the pavements, alone and in groups."""

    groups: tuple[int, int] = setting((3, 8), "fewest and most groups within reach of the ego vehicle")
    group_size: tuple[int, int] = setting((1, 4), "fewest and most people in a group")
    walking_speed: Range = setting((1.0, 1.7), "speed at which a group likes to walk, m/s")
    pause_interval: float = setting(20.0, "mean time between a group's stops, s")
    pause_duration: float = setting(4.0, "mean duration of a stop, s")
    jitter: float = setting(0.25, "standard deviation of a person's place around that in the group, m")

    def __post_init__(self) -> None:
        _require_counts(self, "groups", "group_size")
        _require_positive(self, "walking_speed", "pause_interval", "pause_duration")
        require_between(self, 0, math.inf, "jitter")


@dataclass(frozen=True)
class CyclistSettings:
    """Riders on bicycles at the edges of the road."""

    count: tuple[int, int] = setting((0, 0), "fewest and most riders in each direction")
    speed: Range = setting((3.5, 6.5), "speed that a rider likes, m/s")
    spread: float = setting(1.0, "standard deviation of a rider's speed about that, m/s")
    change_time: float = setting(2.5, "correlation time of a rider's speed, s")

    def __post_init__(self) -> None:
        _require_positive(self, "speed", "change_time")
        require_between(self, 0, math.inf, "spread")
        _require_counts(self, "count")


@dataclass(frozen=True)
class RoadworkSettings:
    """A right lane closed by cones: a taper that pushes its traffic into the lane beside, then a row along that."""

    probability: float = setting(0.0, "share of the scenes with a lane that ends whose lane is closed by cones")
    taper: Range = setting((30.0, 45.0), "length of the taper, m")
    row: Range = setting((25.0, 50.0), "length of the row of cones behind it, m")
    spacing: float = setting(4.0, "distance between cones, m")
    notice: Range = setting((60.0, 110.0), "how far before the taper drivers begin to fit themselves in, m")
    early: float = setting(10.0, "the earliest drivers leave the lane so long before the latest, m")

    def __post_init__(self) -> None:
        _require_positive(self, "taper", "row", "spacing", "notice")
        require_between(self, 0, 1, "probability")
        require_between(self, 0, math.inf, "early")


@dataclass(frozen=True)
class LightSettings:
    """What is known, and seen, of the traffic lights."""

    amber_duration: float = setting(3.0, "so long a light is amber before it is red, as part of its red phase, s")
    mapped: bool = setting(False, "whether frames bring a map along, of lights, stop lines and lanes")
    map_noise: float = setting(0.2, "standard deviation of the places in the map, m")
    visible_range: float = setting(80.0, "the colour of a light can be seen from this far, m")

    def __post_init__(self) -> None:
        require_between(self, 0, math.inf, "amber_duration", "map_noise", "visible_range")


@dataclass(frozen=True)
class SurroundingSettings:
    """What stands beside the road and hides what moves on it."""

    parking_probability: float = setting(0.35, "share of roadsides with a strip of parked cars")
    parking_occupancy: float = setting(0.5, "share of parking places taken")
    hedge_length: Range = setting((4.0, 14.0), "length of an unbroken piece of hedge, m")
    hedge_gap: Range = setting((5.0, 18.0), "gap between pieces of hedge, m")
    hedge_height: float = setting(2.2, "height of a hedge, m")
    building_length: Range = setting((10.0, 30.0), "length of a building, m")
    building_gap: Range = setting((2.0, 25.0), "gap between buildings, m")

    def __post_init__(self) -> None:
        _require_positive(self, "hedge_length", "hedge_gap", "hedge_height", "building_length", "building_gap")


@dataclass(frozen=True)
class SensorSettings:
    """One sensor with its detector. Noise is drawn along the range and bearing axes, independently each time.

    The chance to detect an object is detection_probability * ramp(visible share) / (1 + exp((range - reach) / fading)),
    the ramp rising from 0 at `hidden_share` to 1 at `clear_share`.
    """

    rate: float = setting(10.0, "frames per second, 1/s")
    offset: float = setting(0.0, "time of the first frame after the start of the scene, s")
    field_of_view: float = setting(2 * math.pi, "horizontal field of view, centred straight ahead, rad")
    position: tuple[float, float, float] = setting((0.94, 0.0, 1.84), "mounting place on the vehicle (x, y, z), m")
    max_range: float = setting(60.0, "nothing is detected beyond, m")
    range_noise: tuple[float, float] = setting((0.10, 0.002), "range error: standard deviation at 0 m, and per m")
    bearing_noise: tuple[float, float] = setting((0.08, 0.002), "sideways error: deviation at 0 m, m, and per m (rad)")
    height_noise: float = setting(0.08, "standard deviation of the elevation, m")
    size_noise: float = setting(0.05, "relative standard deviation of length, width, height")
    yaw_noise: float = setting(0.05, "standard deviation of the heading, rad")
    velocity_noise: float | None = setting(
        None, "standard deviation of each velocity component, m/s; null: no velocity"
    )
    range_rate_noise: float | None = setting(
        None, "standard deviation of the range rate over ground, m/s; null: no range rate"
    )
    boxes: bool = setting(True, "whether it measures sizes and headings")
    class_accuracy: float = setting(1.0, "chance that it tells cars, trucks and buses rightly, else for another")
    colour_accuracy: float | None = setting(
        None, "chance that it tells the colour of a traffic light rightly; null: it sees no colours"
    )
    detection_probability: float = setting(0.97, "chance to detect a clearly visible object close by")
    hidden_share: float = setting(0.15, "visible share up to which an object is never detected")
    clear_share: float = setting(0.35, "visible share from which occlusion does not matter")
    reach: float = setting(60.0, "range at which the chance to detect an object has halved, m")
    fading: float = setting(6.0, "how gradually it falls there, m")
    clutter_rate: float = setting(2.0, "mean number of false detections a frame")
    true_logit: float = setting(2.0, "mean logit of the score of a clearly visible object close by")
    clutter_logit: float = setting(-1.5, "mean logit of the score of a false detection")
    logit_noise: float = setting(0.8, "standard deviation of the logit of the score")

    def __post_init__(self) -> None:
        _require_positive(self, "rate", "max_range", "reach", "fading")
        if not 0 < self.field_of_view <= 2 * math.pi + 1e-9:
            raise InputError(f"field_of_view: expected an angle in (0, 2 pi] rad, got {self.field_of_view}")
        if self.colour_accuracy is not None:
            require_between(self, 0, 1, "colour_accuracy")
        require_between(self, 0, 1, "class_accuracy")
        if not 0 <= self.detection_probability <= 1:
            raise InputError(f"detection_probability: expected a share in [0, 1], got {self.detection_probability}")
        if not self.hidden_share < self.clear_share:
            raise InputError(
                f"clear_share: expected more than hidden_share {self.hidden_share}, got {self.clear_share}"
            )


def lidar() -> SensorSettings:
    """A LiDAR on the roof that looks all around."""
    return SensorSettings()


def camera() -> SensorSettings:
    """A front camera: good bearings, poor ranges, noisy velocities, its own clock."""
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
        fading=6.0,
        clutter_rate=3.0,
        true_logit=1.2,
        clutter_logit=-1.2,
        logit_noise=1.0,
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
class SimulatorSettings:
    """Everything that shapes simulated scenes."""

    duration: float = setting(20.0, "length of a scene, s")
    keyframe_rate: float = setting(10.0, "moments a second at which ground truth is given and tracks are wanted, 1/s")
    step: float = setting(0.05, "integration step, s")
    warm_up: float = setting(15.0, "time simulated before the scene starts, s")
    annotation_range: float = setting(60.0, "distance from the ego vehicle within which objects are annotated, m")
    visible_share: float = setting(0.25, "an object counts as visible when a sensor sees at least this share of it")
    shortest_view: float = setting(1.0, "and for at least this long; a mere glimpse does not count, s")
    memory: float = setting(4.0, "a hidden object is annotated for this long after it was last visible, s")
    road: RoadSettings = settings_group(RoadSettings, "the road")
    drivers: DriverSettings = settings_group(DriverSettings, "how people drive")
    traffic: TrafficSettings = settings_group(TrafficSettings, "what is on the road")
    pedestrians: PedestrianSettings = settings_group(PedestrianSettings, "people on foot")
    surroundings: SurroundingSettings = settings_group(SurroundingSettings, "what stands beside the road")
    cyclists: CyclistSettings = settings_group(CyclistSettings, "riders on bicycles")
    roadworks: RoadworkSettings = settings_group(RoadworkSettings, "lanes closed by cones")
    lights: LightSettings = settings_group(LightSettings, "traffic lights")
    sensors: dict[str, SensorSettings] = settings_group(
        lambda: {"lidar": lidar(), "camera": camera()}, "sensors on the ego vehicle, by name"
    )

    def __post_init__(self) -> None:
        _require_positive(self, "duration", "keyframe_rate", "step", "annotation_range")
        if self.warm_up < 0:
            raise InputError(f"warm_up: expected a time of at least 0 s, got {self.warm_up}")
