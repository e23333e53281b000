"""Frames of made-up traffic for tests of trackers: cars with known motion, seen with known noise."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame, Tracker, Tracks
from saga_fg.numerics.geometry import inverse_transform, yaw_transform

NAN = float("nan")
SIZE = (4.5, 1.9, 1.6)


def frame(timestamp, position, sensor="lidar", label="car", yaw=0.0, velocity=None, score=0.9, size=SIZE, **fields):
    """A frame of objects at (x, y) positions; whatever is one value serves all."""
    position = np.asarray(position, dtype=float).reshape(-1, 2)
    n = len(position)
    boxes = Boxes.of(
        np.broadcast_to(np.asarray(label, dtype=np.str_), n),
        np.concatenate([position, np.ones((n, 1))], axis=1),
        np.broadcast_to(np.asarray(size, dtype=float), (n, 3)),
        np.broadcast_to(np.asarray(yaw, dtype=float), n),
        None if velocity is None else np.broadcast_to(np.asarray(velocity, dtype=float), (n, 2)),
    )
    return Frame(timestamp, sensor, Detections(boxes, np.broadcast_to(np.asarray(score, dtype=float), n)), **fields)


def seen(rng, truth, times, noise=0.1, sensor="lidar", **fields):
    """Frames at `times` of the objects whose positions `truth(t)` (n, 2) gives, with noise in m."""
    return [frame(t, truth(t) + noise * rng.normal(size=np.shape(truth(t))), sensor, **fields) for t in times]


def straight(start, velocity):
    """Objects that keep their velocities: a function of time."""
    start, velocity = np.atleast_2d(np.asarray(start, dtype=float)), np.atleast_2d(np.asarray(velocity, dtype=float))
    return lambda t: start + velocity * t


def run(tracker, frames):
    return [tracker.step(f) for f in frames]


def at_pose(world_frame, world_T_ego, coordinates, ego_T_sensor=None):
    """Return the frame as a moving vehicle reports it, in ego or sensor coordinates."""
    world_T_source = world_T_ego if coordinates == "ego" else world_T_ego @ ego_T_sensor
    detections = world_frame.detections.transformed(inverse_transform(world_T_source))
    return Frame(world_frame.timestamp, world_frame.sensor, detections, world_T_ego, coordinates)


def turning_vehicle(t):
    """A pose that moves and turns."""
    return yaw_transform(3.0 * t, 0.5 * t**2, 0.2, 0.3 * t)


def columns(tracks):
    """All that a table of tracks says, for exact comparison."""
    b = tracks.boxes
    return {
        "timestamp": tracks.timestamp,
        "id": tracks.id.tolist(),
        "label": b.label.tolist(),
        **{name: getattr(b, name).tobytes() for name in ("position", "size", "yaw", "velocity")},
        **{
            name: getattr(tracks, name).tobytes()
            for name in ("score", "position_covariance", "velocity_covariance", "coasting")
        },
    }


def assert_same(first, second, tolerance=1e-8, covariances=None, shift=(0.0, 0.0, 0.0)):
    """Two tables of tracks, or lists of them, say the same; the second one's places are shifted."""
    for a, b in zip(*([one] if isinstance(one, Tracks) else one for one in (first, second)), strict=True):
        assert (b.timestamp, b.id.tolist()) == (pytest.approx(a.timestamp), a.id.tolist())
        assert b.boxes.label.tolist() == a.boxes.label.tolist()
        assert b.boxes.position - shift == pytest.approx(a.boxes.position, rel=0, abs=tolerance)
        for name in ("velocity", "yaw", "size"):
            expected = pytest.approx(getattr(a.boxes, name), rel=0, abs=tolerance, nan_ok=True)
            assert getattr(b.boxes, name) == expected, name
        relative = tolerance if covariances is None else covariances
        for name in ("position_covariance", "velocity_covariance"):
            assert getattr(b, name) == pytest.approx(getattr(a, name), rel=relative, abs=tolerance), name
        assert b.score == pytest.approx(a.score, rel=0, abs=tolerance)
        assert b.coasting == pytest.approx(a.coasting, abs=1e-9)


def assert_estimators_agree(settings, sensors, frames, tolerance=1e-8, covariances=None):
    """Every estimator gives the tracks of the Kalman filter, which are returned."""
    expected = run(Tracker(settings, sensors), frames)
    for name in ("isam2", "fixed-lag"):
        found = run(Tracker(replace(settings, estimator=name), sensors), frames)
        assert_same(expected, found, tolerance, covariances)
    return expected
