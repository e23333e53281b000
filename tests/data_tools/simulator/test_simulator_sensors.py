"""Simulated sensors, occlusion and roads."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_tools.simulator.road import LaneOrder, Lanes, Road, curved_road, smooth_step, smooth_step_slope
from data_tools.simulator.sensed_world import (
    detect,
    detection_probability,
    in_view,
    outside_outages,
    points_on,
    range_drifts,
    sensor_position,
)
from data_tools.simulator.settings import SensorSettings, camera, far_camera, lidar, radar, sparse_lidar
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections

POSE = yaw_transform(800.0, 400.0, 0.0, 2.0)
COUNT = 1200  # frames
CENTRED = replace(lidar(), position=(0.0, 0.0, 1.8))


def cars(ego_positions: FloatArray) -> Boxes:
    """Cars at horizontal places (N, 2) in the vehicle's frame, at 5 m/s, in world coordinates."""
    n = len(ego_positions)
    position = np.column_stack([ego_positions, np.full(n, 0.8)])
    boxes = Boxes.of(
        ["car"] * n, position, np.tile([4.5, 1.8, 1.6], (n, 1)), np.full(n, 0.3), np.tile([5.0, 0.0], (n, 1))
    )
    return boxes.transformed(POSE)


def detections(sensor: SensorSettings, boxes: Boxes, share: float = 1.0, frames: int = 200) -> list[Detections]:
    rng = np.random.default_rng(7)
    return [detect(sensor, POSE, boxes, np.full(len(boxes), share), rng) for _ in range(frames)]


def within(value: float, expected: float, standard_error: float) -> bool:
    return abs(value - expected) < 4 * standard_error


@pytest.mark.parametrize(("sensor", "distance"), [(lidar(), 40.0), (camera(), 10.0)], ids=["lidar", "camera"])
def test_errors_along_and_across_the_line_of_sight(sensor, distance):
    sensor = replace(sensor, position=(0.0, 0.0, 1.5), clutter_rate=0.0, detection_probability=1.0, reach=1e6)
    bearing = 0.5
    place = distance * np.array([[np.cos(bearing), np.sin(bearing)]])
    truth = cars(place)
    found = Detections(
        Boxes.concatenate([d.boxes for d in detections(sensor, truth, frames=COUNT)]), np.full(COUNT, 0.5)
    ).boxes
    error = found.position - truth.position
    u = np.array([np.cos(bearing + 2.0), np.sin(bearing + 2.0)])
    along, across = error[:, :2] @ u, error[:, :2] @ np.array([-u[1], u[0]])
    for sample, (base, slope) in ((along, sensor.range_noise), (across, sensor.bearing_noise)):
        sigma = base + slope * distance
        assert within(sample.mean(), 0.0, sigma / math.sqrt(COUNT))
        assert within(sample.std(), sigma, sigma / math.sqrt(2 * COUNT))
    assert within(error[:, 2].std(), sensor.height_noise, sensor.height_noise / math.sqrt(2 * COUNT))
    assert within((found.yaw - truth.yaw).std(), sensor.yaw_noise, sensor.yaw_noise / math.sqrt(2 * COUNT))
    assert within(np.log(found.size / truth.size).std(), sensor.size_noise, sensor.size_noise / math.sqrt(6 * COUNT))
    if sensor.velocity_noise is None:
        assert np.isnan(found.velocity).all()
    else:
        velocity_error = found.velocity - truth.velocity
        assert within(velocity_error.std(), sensor.velocity_noise, sensor.velocity_noise / math.sqrt(4 * COUNT))


@pytest.mark.parametrize(("share", "distance"), [(0.25, 10.0), (0.1, 10.0), (1.0, 59.0)])
def test_the_rate_of_misses(share, distance):
    sensor = replace(CENTRED, clutter_rate=0.0)
    angle = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    boxes = cars(distance * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    count = sum(map(len, detections(sensor, boxes, share)))
    ramp = min(max((share - 0.15) / 0.2, 0.0), 1.0)
    p = 0.97 * ramp / (1 + math.exp((distance - 60.0) / 6.0))
    one = boxes.select([0])
    assert detection_probability(sensor, sensor_position(sensor, POSE), one, np.array([share]))[0] == pytest.approx(p)
    assert within(count / 10_000, p, math.sqrt(p * (1 - p) / 10_000) + 1e-12)


def test_the_rate_of_clutter_and_where_it_falls():
    sensor = replace(camera(), position=(0.0, 0.0, 1.5), clutter_rate=2.5)
    found = detections(sensor, Boxes.empty(), frames=COUNT)
    counts = np.array([len(d) for d in found])
    assert within(counts.mean(), 2.5, math.sqrt(2.5 / COUNT))
    assert within(counts.var(), 2.5, 2.5 * math.sqrt(2.4 / COUNT))  # Poisson: variance of the sample variance
    everything = Boxes.concatenate([d.boxes for d in found])
    assert in_view(sensor, POSE, everything.position).all()
    distance = np.linalg.norm(everything.position[:, :2] - POSE[:2, 3], axis=1)
    near = (distance < sensor.max_range / 2).mean()
    assert within(near, 0.25, math.sqrt(0.25 * 0.75 / len(distance)))  # evenly over the area


def test_nothing_is_seen_outside_the_field_of_view():
    sensor = replace(camera(), position=(0.0, 0.0, 1.5), clutter_rate=0.0, detection_probability=1.0, reach=1e6)
    half = sensor.field_of_view / 2
    bearing = np.array([0.0, half - 0.05, -half + 0.05, half + 0.05, -half - 0.05, np.pi])
    boxes = cars(30.0 * np.stack([np.cos(bearing), np.sin(bearing)], axis=1))
    assert in_view(sensor, POSE, boxes.position).tolist() == [True, True, True, False, False, False]
    counts = [len(d) for d in detections(sensor, boxes, frames=20)]
    assert counts == [3] * 20
    far = cars(np.array([[sensor.max_range + 1.0, 0.0]]))
    assert not any(map(len, detections(sensor, far, frames=20)))


def test_scores_tell_true_from_false_but_not_always():
    sensor = camera()
    boxes = cars(np.array([[15.0, 0.0], [30.0, 5.0]]))
    true = np.concatenate([d.score for d in detections(replace(sensor, clutter_rate=0.0), boxes)])
    hidden = np.concatenate([d.score for d in detections(replace(sensor, clutter_rate=0.0), boxes, 0.3)])
    false = np.concatenate([d.score for d in detections(sensor, Boxes.empty(), frames=400)])
    assert ((true > 0) & (true < 1)).all()
    assert true.mean() > hidden.mean() > false.mean()
    better = (true[:, None] > false[None, :]).mean()
    assert 0.85 < better < 0.999  # area under the ROC curve


def test_a_radar_measures_the_velocity_along_its_line_of_sight_and_no_boxes():
    sensor = replace(radar(), position=(0.0, 0.0, 0.5), clutter_rate=0.0, detection_probability=1.0, reach=1e6)
    bearing, noise = 0.5, sensor.range_rate_noise
    assert noise is not None
    truth = cars(30.0 * np.array([[np.cos(bearing), np.sin(bearing)]]))
    found = detections(sensor, truth, frames=COUNT)
    error = np.concatenate([d.range_rate for d in found]) - 5.0 * math.cos(bearing)
    assert within(error.mean(), 0.0, noise / math.sqrt(COUNT))
    assert within(error.std(), noise, noise / math.sqrt(2 * COUNT))
    assert all(np.isnan(d.boxes.size).all() and np.isnan(d.boxes.yaw).all() for d in found)
    false = detections(replace(sensor, clutter_rate=5.0), Boxes.empty())
    assert np.abs(np.concatenate([d.range_rate for d in false])).max() < 6 * noise


def test_points_on_an_object_fall_with_the_square_of_the_distance():
    boxes = Boxes.of(
        ["car"] * 2, [[20.0, 0.0, 0.8], [40.0, 0.0, 0.8]], np.tile([4.5, 1.8, 1.6], (2, 1)), [0.0, np.pi / 2]
    )
    n = points_on((0.01, 0.02), np.zeros(3), boxes, np.array([1.0, 0.5]))
    assert n == pytest.approx([1.8 * 1.6 / 20**2 / 2e-4, 0.5 * 4.5 * 1.6 / 40**2 / 2e-4])  # from behind, from the side


def test_range_drifts_are_of_their_deviation_and_last_for_their_time():
    time = np.arange(0, 40, 0.1)
    drift = range_drifts(replace(camera(), range_drift=0.03), time, 2000, np.random.default_rng(0))
    assert drift.std(axis=1) == pytest.approx(np.full(len(time), 0.03), rel=0.1)
    later = [np.corrcoef(drift[0], drift[k])[0, 1] for k in (20, 300)]
    assert later == pytest.approx([math.exp(-1), 0.0], abs=0.09)
    assert not range_drifts(camera(), time, 3, np.random.default_rng(0)).any()


def test_no_frame_comes_in_an_outage():
    time = np.arange(0, 5000, 0.1)
    left = outside_outages(replace(lidar(), outage_interval=10.0), time, np.random.default_rng(0))
    assert np.isin(left, time).all()
    assert len(left) / len(time) == pytest.approx(10 / 12, abs=0.03)
    gaps = np.diff(left)
    assert ((gaps < 0.11) | ((gaps > 0.95) & (gaps < 3.2))).mean() > 0.998  # two outages may follow at once
    assert outside_outages(lidar(), time, np.random.default_rng(0)) is time


# Roads and lanes: arc length, headings and metric agree with finite differences of positions


def winding_road() -> Road:
    return curved_road(600.0, [(200.0, 1.0, 200.0), (420.0, -0.8, 150.0)], np.array([700.0, -300.0]), 0.4)


def test_roads_turn_by_their_bends_and_run_on_straight():
    road = winding_road()
    s = np.linspace(0, 600, 2001)
    step = np.diff(road.position(s, np.zeros_like(s)), axis=0)
    assert np.linalg.norm(step, axis=1) == pytest.approx(np.full(2000, 0.3), rel=1e-3)
    assert road.heading_at(np.array(0.0)) == pytest.approx(0.4)
    assert road.heading_at(np.array(300.0)) == pytest.approx(1.4, abs=1e-6)
    assert road.heading_at(np.array(600.0)) == pytest.approx(0.6, abs=1e-6)
    assert np.abs(road.curvature).max() == pytest.approx(2 * 0.8 / 150, rel=1e-3)
    road = winding_road()
    ahead = road.position(np.array([600.0, 650.0]), np.array([2.0, 2.0]))
    assert ahead[1] - ahead[0] == pytest.approx(50 * np.array([np.cos(0.6), np.sin(0.6)]), abs=1e-6)
    x = np.linspace(-0.2, 1.2, 1401)
    assert smooth_step(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])) == pytest.approx([0, 0, 0.5, 1, 1])
    assert np.gradient(smooth_step(x), x) == pytest.approx(smooth_step_slope(x), abs=2e-3)


@settings(max_examples=50)
@given(s=st.floats(20, 580), d=st.floats(-12, 12), slope=st.floats(-0.3, 0.3), sign=st.sampled_from([1, -1]))
def test_heading_and_metric_are_those_of_the_path(s, d, slope, sign):
    lanes = Lanes(winding_road(), np.array([d]), np.array([sign]))
    lane = np.zeros(2, dtype=np.int64)
    h = 0.5
    along = np.array([s - h, s + h])
    offset = np.array([d - h * slope, d + h * slope])
    position, _ = lanes.pose(lane, along, offset, np.full(2, slope))
    _, heading = lanes.pose(lane[:1], np.array([s]), np.array([d]), np.array([slope]))
    metric = lanes.metric(lane[:1], np.array([s]), np.array([d]), np.array([slope]))
    chord = position[1] - position[0]
    assert np.linalg.norm(chord) / (2 * h) == pytest.approx(metric[0], rel=5e-3)
    direction = np.array([np.cos(heading[0]), np.sin(heading[0])])
    assert direction @ chord / np.linalg.norm(chord) == pytest.approx(1.0, abs=1e-4)


def test_an_on_ramp_approaches_its_place_beside_the_road():
    lanes = Lanes(
        curved_road(600.0, [], np.zeros(2), 0.0),
        np.array([-2.0, -5.5, 2.0]),
        np.array([1, 1, -1]),
        ending=1,
        end=400.0,
        opening=300.0,
        approach=25.0,
        approach_length=100.0,
    )
    s = np.array([100.0, 200.0, 250.0, 300.0, 390.0])
    d, slope = lanes.lateral(np.ones(5, dtype=np.int64), s)
    assert d == pytest.approx([-30.5, -30.5, -18.0, -5.5, -5.5])
    assert slope[[0, 3, 4]] == pytest.approx([0, 0, 0])
    h = 1e-4
    after, _ = lanes.lateral(np.array([1]), np.array([250.0 + h]))
    assert slope[2] == pytest.approx((after[0] - d[2]) / h, rel=1e-3)
    none = np.array([-1, -1, -1])
    assert lanes.neighbour(np.array([0, 1, 2]), 1).tolist() == [1, -1, -1]
    assert lanes.neighbour(np.array([0, 1, 2]), -1).tolist() == [-1, 0, -1]
    assert not lanes.may_change(np.array([0, 1, 2]), none, np.full(3, 350.0)).any()
    assert not lanes.may_change(np.array([0]), np.array([1]), np.array([350.0]))[0]  # nobody enters a lane that ends
    assert lanes.may_change(np.array([1, 1]), np.array([0, 0]), np.array([350.0, 250.0])).tolist() == [True, False]


@given(st.data())
def test_neighbours_are_those_of_a_plain_search(data):
    n = data.draw(st.integers(0, 12))
    s = np.array(data.draw(st.lists(st.integers(0, 900), min_size=n, max_size=n, unique=True)), dtype=np.float64)
    lane = np.array(data.draw(st.lists(st.integers(0, 2), min_size=n, max_size=n)), dtype=np.int64)
    also = np.array(data.draw(st.lists(st.integers(-1, 2), min_size=n, max_size=n)), dtype=np.int64)
    also = np.where(also == lane, -1, also)
    order = LaneOrder.by_position(s, np.stack([lane, also], axis=1))
    target = np.array(data.draw(st.lists(st.integers(-1, 2), min_size=n, max_size=n)), dtype=np.int64)
    ahead, behind = order.ahead(target, s), order.behind(target, s)
    for i in range(n):
        there = [j for j in range(n) if target[i] >= 0 and target[i] in (lane[j], also[j])]
        front = [j for j in there if s[j] > s[i]]
        rear = [j for j in there if s[j] < s[i]]
        assert ahead[i] == (min(front, key=lambda j: s[j]) if front else -1)
        assert behind[i] == (max(rear, key=lambda j: s[j]) if rear else -1)


def test_a_camera_sees_a_person_where_a_lidar_has_too_few_points():
    boxes = Boxes.of(
        ["pedestrian", "truck"], [[55.0, 0.0, 0.9], [55.0, 0.0, 1.8]], [[0.65, 0.65, 1.72], [8.0, 2.5, 3.4]], [0.0, 0.0]
    )
    person, truck = detection_probability(sparse_lidar(), np.zeros(3), boxes, np.ones(2))
    assert person < 0.25 < 0.9 < truck
    assert detection_probability(far_camera(), np.zeros(3), boxes, np.ones(2))[0] > 0.7
