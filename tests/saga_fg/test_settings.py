"""Settings carry a comment for people, and refuse numbers outside their range."""

import dataclasses
import inspect
import math
from collections.abc import Mapping
from typing import Annotated

import pytest

from saga_fg import ConstantAcceleration, ConstantVelocity, GreedyTracker, InputError, RandomWalk, Sensor
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.model.sensor import Extrinsics, FieldOfView, NoiseModel
from saga_fg.settings import Finite, Positive, PositiveOrInf, Range, Settings, setting, settings_group
from saga_fg.tracking import ClassSettings, ExistenceSettings, GreedySettings, TrackerSettings

SETTINGS = [
    CarFollowing,
    ClassSettings,
    ConstantAcceleration,
    ConstantVelocity,
    ExistenceSettings,
    Extrinsics,
    FieldOfView,
    Following,
    GreedySettings,
    Neighbours,
    NoiseModel,
    RandomWalk,
    Sensor,
    SharedVelocity,
    TrackerSettings,
]


def test_every_setting_has_a_default_and_a_comment_and_cannot_be_changed(subtests):
    for kind in SETTINGS:
        with subtests.test(kind=kind):
            defaults = kind()
            assert defaults == kind()
            for field in dataclasses.fields(kind):
                assert field.metadata["comment"], f"{kind.__name__}.{field.name}"
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(defaults, dataclasses.fields(kind)[0].name, None)


def test_groups_are_made_anew():
    @dataclasses.dataclass(frozen=True)
    class Outer:
        number: int = setting(3, "a number")
        names: dict[str, int] = settings_group(dict, "names")

    assert Outer().number == 3
    assert Outer().names == {}
    assert Outer().names is not Outer().names


def test_numbers_out_of_range_are_refused(subtests):
    for kind, values, message in [
        (ConstantVelocity, {"acceleration_noise": -1.0}, "acceleration_noise: expected a finite number >= 0, got -1.0"),
        (ConstantVelocity, {"acceleration_noise": math.nan}, "acceleration_noise: expected a finite number >= 0"),
        (ConstantAcceleration, {"jerk_noise": math.inf}, "jerk_noise: expected a finite number >= 0, got inf"),
        (ConstantAcceleration, {"fading_time": 0.0}, "fading_time: expected a number > 0, got 0.0"),
        (RandomWalk, {"drift": -0.1}, "drift: expected a finite number >= 0"),
        (CarFollowing, {"time_constant": 0.0}, "time_constant: expected a number > 0"),
        (CarFollowing, {"headway": -1.0}, "headway: expected a finite number >= 0"),
        (Neighbours, {"rate": -0.1}, "rate: expected a finite number >= 0"),
        (Neighbours, {"distance_scale": 0.0}, "distance_scale: expected a number > 0"),
        (Neighbours, {"max_degree": -1}, "max_degree: expected a finite number >= 0"),
        (Following, {"rate": math.nan}, "rate: expected a finite number >= 0"),
        (Following, {"lateral_scale": 0.0}, "lateral_scale: expected a number > 0"),
        (NoiseModel, {"position": 0.0}, "position: expected a finite number > 0, got 0.0"),
        (NoiseModel, {"velocity": math.inf}, "velocity: expected a finite number > 0, got inf"),
        (NoiseModel, {"yaw": 0.0}, "yaw: expected a finite number > 0, got 0.0"),
        (NoiseModel, {"range_noise": -0.1}, "range_noise: expected a finite number >= 0"),
        (FieldOfView, {"max_range": -1.0}, "max_range: expected a number > 0"),
        (FieldOfView, {"min_azimuth": 2.0, "max_azimuth": 1.0}, "max_azimuth: expected at least min_azimuth 2, got 1"),
        (Sensor, {"detection_probability": 1.5}, "detection_probability: expected a number from 0 to 1, got 1.5"),
        (Sensor, {"time_offset": math.nan}, "time_offset: expected a number from"),
        (Sensor, {"score": "logits"}, "score: expected one of probability, logit, got 'logits'"),
        (ClassSettings, {"gate": 1.0}, "gate: expected a number from 0 to below 1"),
        (ClassSettings, {"initiation_score": 2.0}, "initiation_score: expected a number from 0 to 1"),
        (ClassSettings, {"max_distance": 0.0}, "max_distance: expected a number > 0"),
        (ExistenceSettings, {"neutral_score": 1.0}, "neutral_score: expected a number above 0 to below 1, got 1.0"),
        (ExistenceSettings, {"report_above": 1.1}, "report_above: expected a number from 0 to 1, got 1.1"),
        (TrackerSettings, {"explained_noise": -0.1}, "explained_noise: expected a finite number >= 0"),
        (TrackerSettings, {"tolerance": 1.0}, "tolerance: expected a number from 0 to below 1, got 1.0"),
        (TrackerSettings, {"max_coasting": 0.0}, "max_coasting: expected a number > 0"),
        (TrackerSettings, {"max_delay": -0.1}, "max_delay: expected a finite number >= 0"),
        (GreedySettings, {"max_coasting": math.nan}, "max_coasting: expected a number > 0"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            kind(**values)


@dataclasses.dataclass(frozen=True)
class EveryRange(Settings):
    angle: Annotated[float, Range(0, 3, above=True)] = setting(1.0, "rad")
    count: Annotated[int, Range(2)] = setting(2, "a number")
    offset: Finite = setting(0.0, "m")
    span: Annotated[tuple[float, float], Range(0, ascending=True)] = setting((0.0, 1.0), "m")
    speed: dict[str, Positive] = settings_group(dict, "by class, m/s")
    lag: PositiveOrInf | None = setting(None, "s")
    classes: Mapping[str, GreedySettings] = settings_group(dict, "by class")


def test_a_range_is_that_of_every_entry(subtests):
    for values, message in [
        ({"angle": 0.0}, "angle: expected a number above 0 to 3, got 0.0"),
        ({"count": 1}, "count: expected a finite number >= 2, got 1"),
        ({"offset": -math.inf}, "offset: expected a finite number, got -inf"),
        ({"span": (-1.0, 1.0)}, "span: expected a finite number >= 0, got -1.0"),
        ({"span": (2.0, 1.0)}, "span: expected ascending numbers, got (2.0, 1.0)"),
        ({"speed": {"car": 0.0}}, "speed.car: expected a finite number > 0, got 0.0"),
        ({"lag": 0.0}, "lag: expected a number > 0, got 0.0"),
        ({"offset": "left"}, "offset: expected a finite number, got 'left'"),
        ({"span": (1.0, "far")}, "span: expected a finite number >= 0, got 'far'"),
        ({"classes": {"car": {"gate": 0.9}}}, "classes.car: expected GreedySettings, got dict"),
    ]:
        with subtests.test(message):
            assert EveryRange(angle=3, lag=math.inf, speed={"car": 1.0}).lag == math.inf
            with pytest.raises(InputError) as caught:
                EveryRange(**values)
            assert str(caught.value) == message


def test_scales_may_be_infinite_and_trackers_work_on_defaults():
    assert Neighbours(speed_scale=math.inf).speed_scale == math.inf
    assert Following(gap_scale=math.inf).gap_scale == math.inf
    assert inspect.signature(GreedyTracker).parameters["settings"].default is None
    assert GreedyTracker().settings == GreedySettings()
