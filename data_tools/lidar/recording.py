"""A recording of LiDAR scans: when and where each was taken, how to read it, and the other sensors of the vehicle.

Every layout gives one; `read` returns the scan of a row. What only the whole of a recording shows is checked here: time
that runs backwards, a last scan that was cut off, and scans of another sensor among the others. The latter is told by
the elevations that a sensor sees, from the 2 % to the 98 % quantile: those of one and the same overlap.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from data_tools.lidar.scan import Scan, ScanSequence
from saga_fg.errors import InputError, error_context
from saga_fg.numerics.arrays import FloatArray, checked
from saga_fg.numerics.geometry import checked_transform
from saga_fg.slam.sensors import SensorName
from saga_fg.types.frame import Frame

PERIOD = 0.1  # s between scans of which no time is known
_OVERLAP = 0.3  # of the elevations of scans of one sensor, of those that either sees
_POINTS = 3000  # of a scan that show its elevations
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordingOptions:
    """What to take of a recording.

    sequence  one of several in the source, such as a sequence of KITTI or a scene of nuScenes
    period    s between scans whose times are unknown
    timed     False: without the times of points
    most      scans, from the first on
    blind     KITTI: a scan without points for each record, where none are needed
    topics    of bags, by `lidar`, `laser` and the names of sensors, where there are several
    ego       frame of the vehicle in bags
    mount     (4, 4) place of the sensor on the vehicle, in place of what the recording says
    seed      of the noise of sensors that are made from KITTI's GPS/IMU
    """

    sequence: str | None = None
    period: float = PERIOD
    timed: bool = True
    most: int | None = None
    blind: bool = False
    topics: Mapping[str, str] = field(default_factory=dict)
    ego: str = "base_link"
    mount: FloatArray | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ScanRecording:
    """K scans in order of time, read on access: `data_tools.lidar.scan.ScanSequence`.

    layout       its name
    timestamps   (K,) s
    read         gives the scan of a row; place: what errors call a row, such as its file; clock: where its time is from
    ego_T_lidar  (4, 4) place of the sensor on the vehicle; world_T_ego (K, 4, 4) of the recording, None without
    origin       latitude, longitude (deg) and altitude (m) of that world, None where it is unknown
    sensors      gives tables of the vehicle's sensors by name, as `SensorLog` has them, fixes in that world
    mounts       ego_T_sensor (4, 4) of sensors, where the recording says them; known once `sensors` was called
    objects      gives frames with the detections of a folder, None where there are none
    blind        whether scans have no points, only times
    dropped      points without a place by row, of the scans that were read

    Raises `InputError` for no scans, and for time that does not go on.
    """

    layout: str
    timestamps: FloatArray
    read: Callable[[int], Scan]
    place: Callable[[int], str]
    ego_T_lidar: FloatArray = field(default_factory=lambda: np.eye(4))
    world_T_ego: FloatArray | None = None
    origin: tuple[float, float, float] | None = None
    sensors: Callable[[], Mapping[SensorName, FloatArray]] = dict
    mounts: Mapping[SensorName, FloatArray] = field(default_factory=dict)
    objects: Callable[[Path | None], Sequence[Frame]] | None = None
    clock: Callable[[int], str] | None = None
    blind: bool = False
    timed: bool = True
    dropped: dict[int, int] = field(default_factory=dict)
    _seen: list[FloatArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not len(self.timestamps):
            raise InputError("expected scans, there are none")
        checked("timestamps", self.timestamps, (None,))
        checked_transform("ego_T_lidar", self.ego_T_lidar)
        if len(back := np.flatnonzero(np.diff(self.timestamps) <= 0)):
            where = (self.clock or self.place)(int(back[0]) + 1)
            before, now = self.timestamps[back[0] : back[0] + 2].tolist()
            raise InputError(f"{where}: time: expected one after {before:.6f} s, of the scan before, got {now:.6f} s")

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, row: int) -> Scan:
        """The scan of a row. Raises `InputError` naming it."""
        with error_context(self.place(row)):
            scan = self.read(row)
        if scan.dropped and row not in self.dropped:
            self.dropped[row] = scan.dropped
        self._compare(row, scan)
        return scan if self.timed else replace(scan, time=None)

    def chosen(self, options: RecordingOptions) -> Self:
        """Without what the options leave out, and without a last scan that cannot be read, as one cut off."""
        world_T_ego, count = self.world_T_ego, len(self) if options.most is None else min(options.most, len(self))
        if options.most is None and count > 1:
            try:
                with error_context(self.place(count - 1)):
                    self.read(count - 1)
            except InputError as error:
                _log.warning("%s; the last scan is left out", error)
                count -= 1
        return replace(
            self,
            timestamps=self.timestamps[:count],
            world_T_ego=None if world_T_ego is None else world_T_ego[:count],
            ego_T_lidar=self.ego_T_lidar if options.mount is None else options.mount,
            timed=options.timed,
        )

    def _compare(self, row: int, scan: Scan) -> None:
        """Warn once of elevations that hardly overlap with those of the first scan."""
        if not len(scan) or len(self._seen) > 1:
            return
        x, y, z = scan.points[:: len(scan) // _POINTS + 1].T
        now = np.degrees(np.quantile(np.arctan2(z, np.hypot(x, y)), [0.02, 0.98]))
        if not self._seen:
            self._seen.append(now)
            return
        first = self._seen[0]
        both = min(first[1], now[1]) - max(first[0], now[0])
        if both < _OVERLAP * (max(first[1], now[1]) - min(first[0], now[0])):
            self._seen.append(now)
            _log.warning(
                "%s: its points are at elevations of %.0f to %.0f deg, those of the first scan at %.0f to %.0f: a scan "
                "of another sensor?",
                self.place(row), *now, *first,
            )  # fmt: skip


def scan_context(scans: ScanSequence, row: int) -> AbstractContextManager[None]:
    """Prefix every `InputError` of the block with what the recording calls the scan, if it is one."""
    return error_context(scans.place(row)) if isinstance(scans, ScanRecording) else nullcontext()
