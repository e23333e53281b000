"""A tracker of everything at once goes on alike from snapshots, files and copies, looked at or not."""

import copy
import pickle
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from pipelines.serving.state import TreeWriter, read_tree
from saga_fg import ConstantAcceleration, Curvilinear, Detections, Sensor, Tracker, TrackerSettings
from saga_fg.model.edge_rules import Repulsion
from saga_fg.model.map_rules import GreenLight, RedLight
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import AssociationSettings, ClassSettings
from saga_fg.tracking.traffic import SpeedPriorSettings, TrafficSettings
from saga_fg.types.road_map import Lane, RoadMap, StopLine, TrafficLight
from tests.saga_fg.traffic_frames import NAN, assert_same, columns, frame, run

CONFUSED = {"car": {"car": 0.8, "truck": 0.2}, "truck": {"truck": 0.9, "car": 0.1}}
SENSORS = {
    "lidar": Sensor(noise={"default": NoiseModel(position=0.2)}, calibrate_noise=True, confusion=CONFUSED),
    "camera": Sensor(noise={"default": NoiseModel(position=0.5)}, colour_accuracy=0.9),
    "radar": Sensor(noise={"default": NoiseModel(position=0.8, range_rate=0.1)}),
}
CAR = ClassSettings(Curvilinear(turn_time=2.0, course_time=0.7), max_deviation=6.0, gate=1 - 1e-7)
SETTINGS = TrackerSettings(
    {"default": CAR, "truck": replace(CAR, motion=ConstantAcceleration(0.5, fading_time=3.0))},
    min_hits=2,
    tentative_score_factor=0.1,
    edges=(*TrackerSettings().edges, Repulsion(), RedLight(), GreenLight()),
    edge_prior=0.9,
    max_step=0.2,
    tolerance=0.0,  # exact
    road_map=RoadMap(
        (TrafficLight("light", (62.0, 0.0)),),
        (StopLine("line", (50.0, 1.75), (50.0, -1.75), "light"),),
        (Lane("lane", ((-50.0, 0.0), (50.0, 0.0))),),
    ),
    association=AssociationSettings(clutter_area=3000.0),
    traffic=TrafficSettings(memory=30.0, speed_prior=SpeedPriorSettings(weight=5.0)),
    stationary_share=0.3,
    lag=0.3,
    max_delay=0.5,
)


def everything(seed=0):
    """Cars and a truck in a row, parked cars, walkers who meet, a bend; told late, twice, by numbers and by rates."""
    rng, frames = np.random.default_rng(seed), []
    label = np.array(["car", "truck", "car", "car", "pedestrian", "pedestrian", "car"])
    for k in range(18):
        t = 0.1 * k
        x = 40.0 - max(0.0, 1.0 - t) ** 2 * 4.0  # of the truck, which waits and lets its leader go
        bend = 15 * np.array([np.sin(0.4 * t), 1 - np.cos(0.4 * t)])
        row = [(50.0 + 8.0 * t, 0.0), (x, 0.1), (x - 14, 0.0)]
        apart = abs(t - 1) + 0.05  # of the walkers from where they meet
        truth = np.array([*row, (10, -6), (apart, 9), (-apart, 9), (bend[0], bend[1] + 20)])
        yaw = np.array([0.0, 0.0, 0.0, 0.3, NAN, NAN, 0.4 * t])
        there = (rng.random(7) > 0.1) | (np.arange(7) < 2)
        there[2] &= t < 1.1  # hidden from then on
        z, noise = truth[there], np.array([0.2, 0.5, 0.8])
        confused = np.where((label == "truck") & (rng.random() < 0.3), "car", label)[there]
        shape = {"label": confused, "yaw": yaw[there], "world_T_ego": np.eye(4)}
        lidar = frame(t, z + noise[0] * rng.normal(size=z.shape), score=rng.uniform(0.4, 0.9, len(z)), **shape)
        frames.append((t, lidar))
        seen = frame(t - 0.03, z + noise[1] * rng.normal(size=z.shape), "camera", **shape | {"label": label[there]})
        numbered = replace(seen.detections, identity=np.flatnonzero(there))
        light = frame(t, [(62.0, 0.1 * rng.normal())], label="traffic_light_red").detections
        told = Detections.concatenate([numbered, replace(light, identity=np.array([50]))])
        frames.append((t + 0.17, replace(seen, detections=told)))
        near = frame(
            t + 0.05,
            z[:2] + noise[2] * rng.normal(size=z[:2].shape),
            "radar",
            **shape | {"label": label[there][:2], "yaw": NAN, "size": (NAN,) * 3},
        )
        rates = np.array([8.0, 8.0 * max(0.0, 1.0 - t)]) * np.sign(z[:2, 0]) + 0.1 * rng.normal(size=2)
        frames.append((t + 0.05, replace(near, detections=replace(near.detections, range_rate=rates))))
    return [each for _, each in sorted(frames, key=lambda told: told[0])]


def state_of(value):
    """All that a value is made of, wherever its parts are kept, to the last bit."""
    match value:
        case np.ndarray():
            return value.dtype.str, value.shape, value.tobytes()
        case Mapping():
            return {repr(key): state_of(each) for key, each in value.items()}
        case tuple() | list():
            return type(value).__name__, [state_of(each) for each in value]
        case None | str() | int() | float() | np.generic() | type():
            return repr(value)
    parts = value.__getstate__()
    if is_dataclass(value):  # what is computed of its fields may be kept beside them
        parts = {each.name: getattr(value, each.name) for each in fields(value) if each.name != "_cells"}
    return type(value).__name__, state_of(parts)


def known_to(tracker):
    return state_of(tracker.snapshot())


def restored(tracker, snapshot=None):
    fresh = Tracker(tracker.settings, tracker.sensors)
    fresh.restore(snapshot or tracker.snapshot())
    return fresh


COPIES = {
    "restored": restored,
    "pickled": lambda tracker: pickle.loads(pickle.dumps(tracker)),
    "copied": copy.deepcopy,
    "shallow": copy.copy,
}


@pytest.mark.parametrize("name", ["kalman", "isam2", "fixed-lag"])
def test_copies_of_a_tracker_go_on_as_it_does_and_so_does_one_that_is_watched(name, subtests):
    told, before_then = (everything(), 44) if name == "kalman" else (everything()[:14], 12)  # as slow as graphs are
    tracker = Tracker(replace(SETTINGS, estimator=name), SENSORS)
    run(tracker, told[:before_then])
    before, twins = tracker.snapshot(), {way: made(tracker) for way, made in COPIES.items()}
    later = run(tracker, told[before_then:])
    tracker.restore(before)
    twins["again"] = tracker
    for way, twin in twins.items():
        with subtests.test(way=way):
            for tracks, then in zip(later, told[before_then:], strict=True):
                assert_same(tracks, twin.step(then), 0.0 if name == "kalman" else 1e-8)
                if way == "again":
                    twin.tracks(then.timestamp + 0.5)
                    twin.predict([0.0, 0.3], joint=True)


def test_a_snapshot_is_all_that_a_tracker_knows_and_stays_as_it_is():
    told, tracker = everything(), Tracker(SETTINGS, SENSORS)
    run(tracker, told[:44])
    before, known = tracker.snapshot(), known_to(tracker)
    tree = TreeWriter(before)
    twins = [made(tracker) for made in COPIES.values()] + [restored(tracker, read_tree(tree.nodes, bytes(tree.arrays)))]
    tracker.tracks(9.0)
    tracker.predict([0.5], joint=True)
    assert all(known_to(each) == known for each in [tracker, *twins])
    later = [columns(tracks) for tracks in run(tracker, told[44:])]
    assert [columns(tracks) for tracks in run(twins[-1], told[44:])] == later
    assert known_to(twins[-1]) == known_to(tracker)
    assert all(known_to(each) == known for each in [*twins[:-1], restored(tracker, before)])
