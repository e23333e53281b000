"""Recorded trajectories of traffic on a common time grid, with the road they were driven on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.types.road_map import RoadMap

PERIOD = 0.1  # s between moments
MOST_STATES = 20_000_000  # moments times vehicles of one recording
TRUCK_LENGTH = 7.0  # m, from which a vehicle recorded as a car is a truck
HEIGHTS = {"car": 1.5, "truck": 3.2, "bus": 3.2, "motorcycle": 1.6, "bicycle": 1.7, "pedestrian": 1.7}
"""Assumed heights, m: the recordings have none, and what hides what depends on them."""


@dataclass(frozen=True, eq=False)
class RecordedTraffic:
    """N vehicles at K moments, every 0.1 s from time 0.

    id, label            (N,)
    size                 (N, 3) m, the height assumed by class
    position, velocity   (K, N, 2) m and m/s
    yaw                  (K, N) rad, not wrapped
    present              (K, N) whether the vehicle was recorded; its states are those of the nearest moment where not
    road_map             or None
    colours              (K,) colours of each light of the map by its name; "" while it shows none
    """

    name: str
    id: StrArray
    label: StrArray
    size: FloatArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    present: BoolArray
    road_map: RoadMap | None = None
    colours: Mapping[str, StrArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.position)

    @property
    def time(self) -> FloatArray:
        """(K,) s."""
        return np.arange(len(self), dtype=np.float64) * PERIOD

    def moments(self, kept: slice) -> Self:
        """Successive moments, the first of which is at time 0 again."""
        states = {name: getattr(self, name)[kept] for name in ("position", "velocity", "yaw", "present")}
        return replace(self, **states, colours={light: shown[kept] for light, shown in self.colours.items()})

    def without(self, row: int) -> Self:
        """The other vehicles."""
        rows = np.delete(np.arange(len(self.id)), row)
        own = {name: getattr(self, name)[rows] for name in ("id", "label", "size")}
        states = {name: getattr(self, name)[:, rows] for name in ("position", "velocity", "yaw", "present")}
        return replace(self, **own, **states)


class TrafficRecordings(Protocol):
    """A collection of recordings, read one at a time."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the recordings."""
        ...

    def recording(self, name: str) -> RecordedTraffic:
        """Read one recording; raises `InputError` for an unknown name or a broken record."""
        ...


@dataclass(frozen=True)
class Stretches:
    """The middle of each recording of a collection, at most `longest` s of it."""

    recordings: TrafficRecordings
    longest: float

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the recordings."""
        return self.recordings.names

    def recording(self, name: str) -> RecordedTraffic:
        """Read one recording; raises `InputError` for an unknown name or a broken record."""
        whole = self.recordings.recording(name)
        moments = round(min(self.longest / PERIOD, len(whole) - 1)) + 1
        first = (len(whole) - moments) // 2
        return whole.moments(slice(first, first + moments))


@dataclass(frozen=True, eq=False)
class StateRows:
    """Recorded states, one a row: moment (n,) from 0, vehicle (n,), position (n, 2), velocity (n, 2), yaw (n,)."""

    moment: IntArray
    vehicle: StrArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray

    def traffic(self, name: str, sizes: Mapping[str, tuple[str, float, float]]) -> RecordedTraffic:
        """The rows on the grid; `sizes` are class, length and width by vehicle.

        Raises `InputError` for fewer than two moments, for two rows of one vehicle at one moment, and for a recording
        that does not fit into memory.
        """
        names, column = np.unique(self.vehicle, return_inverse=True)
        K, N = int(self.moment.max(initial=-1)) + 1, len(names)
        if K < 2:
            raise InputError(f"{name}: expected at least two moments, got {K}")
        if K * N > MOST_STATES:
            raise InputError(f"{name}: expected at most {MOST_STATES:.0e} moments times vehicles, got {K} times {N}")
        cell = self.moment * N + column
        cells, count = np.unique(cell, return_counts=True)
        if (count > 1).any():
            k, n = divmod(int(cells[np.argmax(count > 1)]), N)
            raise InputError(f"{name}: vehicle {names[n]}: expected one state at {k * PERIOD:.1f} s, there are more")
        row = np.full((K, N), -1)
        row[self.moment, column] = np.arange(len(cell))
        present = row >= 0
        row = row[_nearest(present), np.arange(N)]
        label, length, width = zip(*(sizes[vehicle] for vehicle in names.tolist()), strict=True)
        labels = np.where((np.array(label) == "car") & (np.array(length) > TRUCK_LENGTH), "truck", np.array(label))
        height = [HEIGHTS.get(each, HEIGHTS["car"]) for each in labels.tolist()]
        size = np.column_stack([length, width, height])
        yaw = np.unwrap(self.yaw[row], axis=0)
        return RecordedTraffic(name, names, labels, size, self.position[row], self.velocity[row], yaw, present)


def _nearest(present: BoolArray) -> IntArray:
    """(K, N) the moment nearest to each at which the vehicle is present; it is so at one at least."""
    K, N = present.shape
    k = np.arange(K)[:, None] * np.ones(N, dtype=np.int64)
    before = np.maximum.accumulate(np.where(present, k, -K), axis=0)
    after = np.minimum.accumulate(np.where(present, k, 2 * K)[::-1], axis=0)[::-1]
    return np.where(k - before <= after - k, before, after)
