"""A made-up drive past parked and moving cars, for tests of the joint estimation."""

import numpy as np

from saga_fg import Boxes, Detections, Frame, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.numerics.geometry import inverse_transform, yaw_transform
from saga_fg.slam.joint import OdometryIncrements
from saga_fg.tracking import ClassSettings

NOISE = 0.1  # m, of detections


def drive(seed=0, n=50, dt=0.2, parked=8, moving=2):
    """Frames in the vehicle's coordinates, true odometry and poses, and true places of the cars (n, cars, 2)."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(n)
    poses = np.stack([yaw_transform(6.0 * s, 0.1 * s * s, 0.5, 0.2 * s / 6) for s in t])
    start = np.column_stack([np.linspace(10, 70, parked), np.where(np.arange(parked) % 2, 6.0, -5.0)])
    movers = np.column_stack([np.linspace(10, 25, moving), np.full(moving, -1.0)])
    cars = np.concatenate([np.tile(start, (n, 1, 1)), movers + np.array([5.0, 0.3]) * t[:, None, None]], axis=1)
    frames = []
    for time, pose, places in zip(t, poses, cars, strict=True):
        world = np.column_stack([places + NOISE * rng.normal(size=places.shape), np.ones(len(places))])
        boxes = Boxes.of(["car"] * len(places), world).transformed(inverse_transform(pose))
        near = np.hypot(*boxes.position[:, :2].T) < 35
        detections = Detections(boxes, np.full(len(boxes), 0.9)).select(near)
        frames.append(Frame(time, "lidar", detections, np.eye(4), "ego"))
    return frames, OdometryIncrements.of(t, poses), poses, cars


def new_tracker():
    noise = {"default": NoiseModel(position=NOISE)}
    return Tracker(TrackerSettings({"default": ClassSettings()}, edges=()), {"default": Sensor(noise=noise)})
