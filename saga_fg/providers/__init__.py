"""Factor providers: the vehicle's odometry, satellite fixes, inertial sensors, wheels, landmarks, stationary objects.

Each reads what a frame brings (`Frame.ego`) and works in the running graph wherever that is: an
`IncrementalSmoother` in Python, the tracker, and by name in a configuration with its fields as settings,

    providers: [{kind: "saga_fg.providers:Odometry"}, {kind: "saga_fg.providers:Gps", deviation: 0.5}]
"""

from saga_fg.providers.gps import Gps
from saga_fg.providers.imu import Imu
from saga_fg.providers.landmarks import Landmarks
from saga_fg.providers.lanes import LaneKeeping
from saga_fg.providers.odometry import Odometry
from saga_fg.providers.relative_detections import RelativeDetections
from saga_fg.providers.start import StartSettings
from saga_fg.providers.stationary import StationaryObjects
from saga_fg.providers.wheels import Wheels

__all__ = [
    "Gps",
    "Imu",
    "Landmarks",
    "LaneKeeping",
    "Odometry",
    "RelativeDetections",
    "StartSettings",
    "StationaryObjects",
    "Wheels",
]
