"""Vehicles and their drivers: kinds, sizes, and driver parameters, which stay constant during a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.driver_models import Drivers
from data_tools.simulator.settings import VAN_SHARE, TrafficSettings
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray

TIME_HEADWAY = 1.2  # T of the IDM (Treiber, Hennecke and Helbing 2000), s: desired time headway
MINIMUM_GAP = 2.0  # s0 of the IDM, m: gap kept at standstill
MAX_ACCELERATION = 1.5  # a of the IDM, m/s^2: maximum acceleration
COMFORTABLE_DECELERATION = 2.0  # b of the IDM, m/s^2: comfortable deceleration
DRIVER_SPREAD = 0.15  # relative standard deviation of the parameters over drivers (log-normal)


@dataclass(frozen=True)
class Kind:
    """Kind of vehicle: class label, mean and deviation of its size, m, and driver parameters relative to a car."""

    name: str
    label: str
    size: tuple[float, float, float]
    spread: tuple[float, float, float]
    speed: float = 1.0
    headway: float = 1.0
    acceleration: float = 1.0


KINDS = (
    Kind("car", "car", (4.6, 1.85, 1.58), (0.3, 0.07, 0.1)),
    Kind("van", "car", (5.3, 2.0, 2.15), (0.4, 0.06, 0.2)),
    Kind("truck", "truck", (8.5, 2.45, 3.3), (1.4, 0.1, 0.3), speed=0.9, headway=1.2, acceleration=0.65),
    Kind("bus", "bus", (11.8, 2.5, 3.1), (0.7, 0.05, 0.15), speed=0.9, headway=1.15, acceleration=0.7),
)
CAR, VAN, TRUCK, BUS = range(4)
HITCH = 0.9  # m between truck and trailer
TRAILER_LENGTH = (6.0, 11.0)  # m


@dataclass(frozen=True, eq=False)
class Fleet:
    """N vehicles: kind (N,) rows of `KINDS`, size (N, 3) m, and drivers of shape (N,)."""

    kind: IntArray
    size: FloatArray
    drivers: Drivers

    @property
    def label(self) -> StrArray:
        return np.array([kind.label for kind in KINDS])[self.kind]

    @property
    def length(self) -> FloatArray:
        return self.size[:, 0]

    def __len__(self) -> int:
        return len(self.kind)


def sample_sizes(kind: IntArray, rng: np.random.Generator) -> FloatArray:
    """Random sizes (N, 3), m, of vehicles of the given kinds, within two deviations of the mean."""
    mean = np.array([k.size for k in KINDS])[kind]
    spread = np.array([k.spread for k in KINDS])[kind]
    return np.asarray(mean + spread * np.clip(rng.standard_normal(mean.shape), -2, 2))


def sample_kinds(count: int, settings: TrafficSettings, rng: np.random.Generator) -> IntArray:
    """Random kinds (count,) of moving vehicles."""
    shares = np.array([VAN_SHARE, settings.truck_share, settings.bus_share])
    return rng.choice(len(KINDS), size=count, p=[1 - shares.sum(), *shares])


def sample_fleet(count: int, desired_speed: float, traffic: TrafficSettings, rng: np.random.Generator) -> Fleet:
    """`count` random vehicles; `desired_speed`, m/s, is the mean over the drivers of cars."""
    kind = sample_kinds(count, traffic, rng)

    def spread(mean: float, factor: FloatArray | float = 1.0) -> FloatArray:
        deviation = np.clip(rng.standard_normal(count), -2.5, 2.5)
        return np.asarray(mean * factor * np.exp(DRIVER_SPREAD * deviation))

    speed, headway, acceleration = (
        np.array([getattr(k, name) for k in KINDS])[kind] for name in ("speed", "headway", "acceleration")
    )
    return Fleet(
        kind,
        sample_sizes(kind, rng),
        Drivers(
            spread(desired_speed, speed),
            spread(TIME_HEADWAY, headway),
            spread(MINIMUM_GAP),
            spread(MAX_ACCELERATION, acceleration),
            spread(COMFORTABLE_DECELERATION),
        ),
    )


def attach_trailers(fleet: Fleet, share: float, rng: np.random.Generator) -> tuple[Fleet, FloatArray]:
    """Attach trailers to a share of the trucks: the fleet with total lengths, and lengths (N,) of trailers, m, or 0."""
    trailer = np.zeros(len(fleet))
    if share > 0:
        tows = (fleet.kind == TRUCK) & (rng.random(len(fleet)) < share)
        trailer = np.where(tows, rng.uniform(*TRAILER_LENGTH, len(fleet)), 0.0)
    size = fleet.size.copy()
    size[:, 0] += np.where(trailer > 0, trailer + HITCH, 0.0)
    return replace(fleet, size=size), trailer
