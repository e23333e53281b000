"""Motion de-skew: points of a sweep transformed to one time.

While the head turns, the vehicle drives on. With constant velocity xi = (w, v) within the sweep, rad/s and m/s in the
sensor's frame, a point p measured t after the scan's timestamp lies, in the sensor's frame at the timestamp, at

    exp(t xi) p = R(t) p + u(t),      k = w / |w|,  a = |w| t
    R(t) p = p + sin(a) k x p + (1 - cos(a)) k x (k x p)
    u(t)   = t v + (1 - cos(a)) / |w| k x v + (t - sin(a) / |w|) k x (k x v)

Source: the exponential of SE(3), e.g. Barfoot, State Estimation for Robotics, 2nd ed. 2024, section 8.1.

For a sensor that turns steadily and gives no times, `azimuth_times` derives them from the azimuths of the points.
"""

from __future__ import annotations

from typing import Literal, get_args

import gtsam
import numpy as np

from data_tools.lidar.scan import Scan
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked

Turning = Literal["clockwise", "counter-clockwise"]


def azimuth_times(points: FloatArray, period: float, turning: Turning = "clockwise") -> FloatArray:
    """Times (N,), s, from -period / 2 to period / 2, of points (N, 3) of a head that turns once a `period` (s).

    At the timestamp the head looks ahead (along x); the scan begins and ends behind. `turning` is as seen from above.
    KITTI's Velodyne turns clockwise.
    """
    if turning not in get_args(Turning):
        raise InputError(f"turning: expected one of {', '.join(get_args(Turning))}, got {turning!r}")
    sign = -1.0 if turning == "clockwise" else 1.0
    return np.asarray(sign * np.arctan2(points[:, 1], points[:, 0]) * (period / (2 * np.pi)))


def deskewed(scan: Scan, velocity: FloatArray) -> Scan:
    """The scan with all points at its timestamp; `velocity` (6,): turn rate, rad/s, and velocity, m/s, sensor's frame.

    Raises `InputError` for a scan without times.
    """
    if scan.time is None:
        raise InputError("time: expected the time of each point, the scan has none; see azimuth_times")
    velocity = checked("velocity", velocity, (6,))
    w, v = velocity[:3], velocity[3:]
    rate = float(np.linalg.norm(w))
    t = scan.time[:, None]
    if rate < 1e-9:
        return Scan(scan.points + t * v, scan.intensity, np.zeros(len(scan)))
    k, a = w / rate, rate * t
    K = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
    sine, rest = np.sin(a), 1 - np.cos(a)
    points = scan.points + sine * (scan.points @ K.T) + rest * (scan.points @ (K @ K).T)
    points += t * v + rest / rate * (K @ v) + (t - sine / rate) * (K @ K @ v)
    return Scan(points, scan.intensity, np.zeros(len(scan)))


def constant_velocity(before_T_now: FloatArray, duration: float) -> FloatArray:
    """Velocity (6,), rad/s and m/s, of a rigid motion (4, 4) within `duration` s."""
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(before_T_now)) / duration)
