"""Settings of the vehicle's sensors, and the factor providers that they make."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, get_args

from saga_fg.errors import InputError
from saga_fg.graph import Additions, FactorProvider, GraphView
from saga_fg.numerics.arrays import FloatArray
from saga_fg.providers import Gps, Imu, StartSettings, Wheels
from saga_fg.providers.mounting import on_pose
from saga_fg.settings import Settings, settings_group

SensorName = Literal["gps", "imu", "wheels"]


@dataclass(frozen=True)
class SensorSettings(Settings):
    """Noise and places of the sensors; which of them there are is said where their measurements come from.

    GPS has no gate here: odometry and fixes come in one step, before the covariance of the pose is known.
    """

    gps: Gps = settings_group(
        lambda: Gps(gate=1.0, outlier_scale=3.0), "satellite receiver; the robust loss takes the place of the gate"
    )
    imu: Imu = settings_group(lambda: Imu(StartSettings(planar=False)), "accelerometers and gyroscopes")
    wheels: Wheels = settings_group(Wheels, "speed of the wheels")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gps.gate < 1:
            raise InputError(
                f"gps.gate: expected 1, as outlier_scale bounds the weight of false fixes, got {self.gps.gate:g}"
            )


@dataclass(frozen=True)
class Inertial:
    """Inertial samples between poses that odometry adds: velocity and biases come after the pose, not before."""

    imu: Imu

    @property
    def name(self) -> str:
        return self.imu.name

    def factors(self, view: GraphView) -> Additions:
        return self.imu.predict(view)


def sensor_providers(
    settings: SensorSettings, sensors: Collection[str], pose_T_vehicle: FloatArray
) -> list[FactorProvider]:
    """The providers of the sensors named, for a graph of poses in space that others add before them.

    pose_T_vehicle: (4, 4) the vehicle, on which the settings place the sensors, in the frame of the graph's pose, such
    as lidar_T_ego. Raises `InputError` for an unknown sensor.
    """
    known = get_args(SensorName)
    unknown = [name for name in sensors if name not in known]
    if unknown:
        raise InputError(f"sensors: expected some of {', '.join(known)}, got {unknown[0]!r}")
    made: dict[str, FactorProvider] = {
        "imu": Inertial(on_pose(settings.imu, pose_T_vehicle)),
        "wheels": on_pose(settings.wheels, pose_T_vehicle),
        "gps": on_pose(settings.gps, pose_T_vehicle),
    }
    return [provider for name, provider in made.items() if name in sensors]
