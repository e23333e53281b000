"""Factor providers: odometry, satellite fixes, inertial sensors, wheels, landmarks, lanes, relative objects.

Each reads what a frame brings (`Frame.ego`) and works in the running graph wherever that is: an
`IncrementalSmoother` in Python, the tracker, and by name in a configuration with its fields as settings,

    providers: [{kind: "saga_fg.providers:Odometry"}, {kind: "saga_fg.providers:Gps", deviation: 0.5}]
"""

from saga_fg.providers.odometry import Odometry, StartSettings
from saga_fg.providers.surroundings import Landmarks, LaneKeeping, RelativeDetections
from saga_fg.providers.vehicle_sensors import GRAVITY, Gps, Imu, Wheels, mounting, on_pose

__all__ = [
    "GRAVITY",
    "Gps",
    "Imu",
    "Landmarks",
    "LaneKeeping",
    "Odometry",
    "RelativeDetections",
    "StartSettings",
    "Wheels",
    "mounting",
    "on_pose",
]
