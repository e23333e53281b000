"""A recording of LiDAR scans: when and where each was taken, how to read it, and the other sensors of the vehicle.

Every layout gives one; `read` returns the scan of a row. What only the whole of a recording shows is checked here: time
that runs backwards, a last scan that was cut off, and scans of two sensors in turn. The latter are told by how
far it is in each direction: a scan is more like the one before than like that before it, if one sensor took them.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from data_tools.lidar.scan import Scan, ScanSequence, cell_order_statistics
from saga_fg.errors import InputError, error_context
from saga_fg.numerics import FloatArray, checked, checked_transform
from saga_fg.slam.sensors import SensorName
from saga_fg.types import Frame

PERIOD = 0.1  # s between scans of which no time is known
_BEARINGS = 36  # directions in which distances are compared
_UNLIKE = 1.5  # times as far from the scan before as from the one before that: none of a moving sensor, or hardly any
_WINDOW, _IN_TURN = 20, 6  # scans that are compared, and those so that tell two sensors
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
    _last: list[int] = field(default_factory=list)  # row that was read
    _profiles: list[FloatArray] = field(default_factory=list)  # of the rows up to it, one after the other
    _unlike: list[bool] = field(default_factory=list)  # which are hardly like the one before

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
        """Raise `InputError` where scans read one after the other are those of two sensors in turn."""
        if self._last != [row - 1]:
            self._profiles.clear()
            self._unlike.clear()
        self._last[:] = [row]
        self._profiles.append(_profile(scan.points))
        if len(self._profiles) > 2:
            earlier, before, now = self._profiles[-3:]
            self._unlike.append(_change(before, now) > _UNLIKE * _change(earlier, now))
        if (count := sum(self._unlike[-_WINDOW:])) >= _IN_TURN:
            raise InputError(
                f"{self.place(row)}: expected scans of one sensor: {count} of the last {_WINDOW} are far less like the "
                "scan before than like the one before that, as those of two sensors in turn"
            )


def _profile(points: FloatArray) -> FloatArray:
    """Logarithms (`_BEARINGS`,) of the median distance in each direction from above, NaN where there are no points."""
    bearing = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * _BEARINGS
    distance = np.log(np.maximum(np.hypot(points[:, 0], points[:, 1]), 0.1))
    return cell_order_statistics(distance, bearing.astype(np.int64) % _BEARINGS, _BEARINGS, 2)


def _change(before: FloatArray, now: FloatArray) -> float:
    """Mean change of two profiles, 0 where they have no direction in common."""
    change = np.abs(now - before)
    known = np.isfinite(change)
    return float(change[known].mean()) if known.any() else 0.0


def scan_context(scans: ScanSequence, row: int) -> AbstractContextManager[None]:
    """Prefix every `InputError` of the block with what the recording calls the scan, if it is one."""
    return error_context(scans.place(row)) if isinstance(scans, ScanRecording) else nullcontext()
