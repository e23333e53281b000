"""The tracker on each estimator: the same tracks; and on the fixed-lag smoother, late frames where they belong."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantAcceleration, ConstantVelocity, Curvilinear, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.tracking import ClassSettings
from tests.saga_fg.traffic_frames import frame, run, seen, straight

CLASSES = {
    "car": ClassSettings(motion=ConstantVelocity(1.0), gate=1 - 1e-7),
    "truck": ClassSettings(motion=ConstantAcceleration(0.5, fading_time=3.0), gate=1 - 1e-7),
}
SENSORS = {
    "lidar": Sensor(noise={"default": NoiseModel(position=0.4, velocity=0.5)}),
    "camera": Sensor(noise={"default": NoiseModel(position=0.2)}),
}
LABEL = ["car", "truck", "car", "car"]
TRUTH = straight([(0, 0), (-15, 0.3), (-30, 0), (5, 40)], [(12, 0), (12, 0), (11, 0), (0, -9)])
ESTIMATORS = ["kalman", "isam2", "fixed-lag"]


def tracker(estimator="kalman", **values):
    """Without bounds, so that all estimators are exact."""
    return Tracker(TrackerSettings(CLASSES, estimator=estimator, tolerance=0.0, **values), SENSORS)


def traffic(seed, late=0.0):
    """Frames in order of time; and in order of arrival, the camera's `late` s after they were taken."""
    rng = np.random.default_rng(seed)
    heading = [0.0, 0.0, 0.0, -np.pi / 2]
    lidar = seen(rng, TRUTH, np.arange(0, 4, 0.1), noise=0.3, label=LABEL, yaw=heading, velocity=TRUTH(1) - TRUTH(0))
    camera = seen(rng, TRUTH, np.arange(1.03, 3.4, 0.08), noise=0.15, sensor="camera", label=LABEL, yaw=heading)
    gone = [f for f in lidar if f.timestamp < 3.45]
    lost = [frame(f.timestamp, TRUTH(f.timestamp)[:3], label=LABEL[:3]) for f in lidar if f.timestamp >= 3.45]
    arrivals = [(f.timestamp, f) for f in [*gone, *lost]] + [(f.timestamp + late, f) for f in camera]
    in_order = sorted((f for _, f in arrivals), key=lambda f: f.timestamp)
    return in_order, [f for _, f in sorted(arrivals, key=lambda arrival: arrival[0])]


def agree(first, second, tolerance):
    assert first.id.tolist() == second.id.tolist()
    assert second.boxes.label.tolist() == first.boxes.label.tolist()
    for name in ("position", "velocity"):
        assert getattr(second.boxes, name) == pytest.approx(getattr(first.boxes, name), abs=tolerance)
    for name in ("position_covariance", "velocity_covariance"):
        assert getattr(second, name) == pytest.approx(getattr(first, name), rel=tolerance, abs=tolerance)
    assert second.coasting == pytest.approx(first.coasting, abs=1e-9)


@pytest.mark.parametrize("estimator", ESTIMATORS[1:])
def test_every_estimator_gives_the_same_tracks(estimator, subtests):
    """New tracks, a deletion, two sensors, two motion models, frames as late as the filters take."""
    for edges in [(), TrackerSettings().edges]:
        with subtests.test(edges=edges):
            in_order, _ = traffic(0)
            reference, other = tracker(edges=edges), tracker(estimator, edges=edges)
            for f in in_order:
                agree(reference.step(f), other.step(f), 1e-8)


@pytest.mark.parametrize("delay", [0.07, 0.9])
def test_a_smoother_takes_late_frames_as_if_they_had_come_in_time(delay):
    """States of independent objects, and so with frozen edges, do not depend on the order of arrival."""
    in_order, arriving = traffic(2, delay)
    prompt, late, without = (tracker("fixed-lag", edges=(), lag=2.0) for _ in range(3))
    run(prompt, in_order)
    run(late, arriving)
    run(without, [f for f in arriving if f.sensor == "lidar"])
    assert late.late_frames == 0
    agree(prompt.tracks(4.5), late.tracks(4.5), 1e-8)
    assert np.abs(prompt.tracks(4.5).boxes.position - without.tracks(4.5).boxes.position).max() > 0.01


def test_how_late_a_frame_may_be_is_the_smoothers_lag():
    smoother, filtering = tracker("fixed-lag", edges=(), lag=2.0), tracker(edges=(), lag=2.0)
    for t in (smoother, filtering):
        run(t, traffic(3)[0])
        t.step(frame(2.2, TRUTH(2.2)[:3], "camera", label=LABEL[:3]))
    assert (smoother.late_frames, filtering.late_frames) == (0, 1)
    smoother.step(frame(1.5, TRUTH(1.5)[:3], "camera", label=LABEL[:3]))
    assert smoother.late_frames == 1


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_late_frames_of_objects_born_since(estimator):
    t = tracker(estimator, edges=())
    t.step(frame(0.0, [(50, 50)]))
    t.step(frame(1.0, [(50, 50), (0, 0)], velocity=(10.0, 0.0)))
    tracks = t.step(frame(0.8, [(50, 50), (-2, 0)], "camera"))
    assert tracks.id.tolist() == [1, 2]
    assert tracks.boxes.position[1, 0] == pytest.approx(0.0, abs=0.1)


def test_an_estimator_that_is_none_is_refused():
    expected = "estimator: expected one of kalman, isam2, fixed-lag, or MODULE:NAME, got 'kallman'"
    with pytest.raises(InputError, match=expected):
        TrackerSettings(estimator="kallman")


@pytest.mark.parametrize("estimator", ESTIMATORS[1:])
def test_every_estimator_takes_the_same_turns(estimator, subtests):
    """Two that turn, one behind the other, of which one is not detected at last."""
    for edges in [(), TrackerSettings().edges]:
        with subtests.test(edges=edges):
            rng, rate, speed = np.random.default_rng(5), 0.3, 8.0
            classes = {
                label: replace(of_class, motion=Curvilinear(turn_time=1.5)) for label, of_class in CLASSES.items()
            }
            settings = TrackerSettings(classes, edges=edges)
            reference, other = (Tracker(replace(settings, estimator=name), SENSORS) for name in ("kalman", estimator))
            for t in np.arange(0, 4, 0.1):
                angle = rate * t - np.array([0.0, 0.4])
                place = speed / rate * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1)
                z, there = place + 0.1 * rng.normal(size=(2, 2)), slice(2 if t < 3 else 1)
                seen_now = frame(t, z[there], label=LABEL[there], yaw=angle[there])
                agree(reference.step(seen_now), other.step(seen_now), 1e-8)
            assert any(reference.graph.motions), "turns were recorded"
            assert np.isclose(np.hypot(*reference.tracks(4.5).boxes.velocity[0]), speed, atol=1.0)
