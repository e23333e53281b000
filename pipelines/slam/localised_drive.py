"""A recording localised in the map of an earlier drive, and its results as files.

trajectory.tum, trajectory.txt, times.txt   poses of the vehicle in the map's frame
reference.tum                               the recording's own poses
covariances.csv of the sensor's pose at each scan, and whether that was registered with the map
metrics.json    errors against these, as they are and with the path aligned; scans, those registered with the map, and
                the first that was; sensors that do not fit or measured too little to tell
above.png       map and paths from above
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.figures import write_figures
from data_tools.files.atomic_files import atomic_directory, write_bytes
from data_tools.lidar.recording import scan_context
from data_tools.lidar.scan import ScanSequence
from data_tools.plots import png, scan_map_from_above
from data_tools.sensor_logs import SensorLog
from data_tools.trajectories import Trajectory, trajectory_errors
from pipelines.slam.localisation import Localiser, LocaliserSettings
from pipelines.slam.results import LIDAR_FILES, reference, write_covariances, write_paths
from pipelines.slam.submaps import SlamMap, placed_clouds
from pipelines.slam.vehicle_sensors import Vehicle
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import inverse_transform


@dataclass(frozen=True, eq=False)
class LocalisedDrive:
    """Poses (K) of the vehicle in the map, and whether each scan (K,) was registered with it.

    covariances (K, 6, 6) of the sensor's poses, (rotation, translation) in its frame, rad^2, m^2
    misfits   what does not fit of the vehicle's sensors, in words, by their names
    unjudged  sensors that have measured too little to tell, likewise
    """

    trajectory: Trajectory
    covariances: FloatArray
    registered: BoolArray
    misfits: Mapping[str, str]
    unjudged: Mapping[str, str]


def localise(
    scans: ScanSequence,
    slam_map: SlamMap,
    guess: FloatArray | None = None,
    settings: LocaliserSettings | None = None,
    progress: Progress | None = None,
    log: SensorLog | None = None,
) -> LocalisedDrive:
    """Localise a recording in a map.

    guess: map_T_ego (4, 4) of the vehicle at the first scan, good to a metre or two and 0.1 rad. None: it is looked
    for, as it is where the scans do not fit the map at the guess. log: of the vehicle's sensors, fixes in the map's
    frame. Of the recording's poses none is used.
    Raises `InputError` where no place of the map was found, or several, and where no scan fits the map.
    """
    log = log or SensorLog({})
    start = None if guess is None else guess @ scans.ego_T_lidar
    localiser = Localiser(slam_map, start, settings, Vehicle(scans.ego_T_lidar, tuple(log.tables), log.settings))
    for k, (time, ego) in enumerate(log.until(scans.timestamps)):
        with scan_context(scans, k):
            localiser.step(scans[k], time, ego.imu, ego.gps, ego.wheels)
        if progress is not None:
            progress("localising", k + 1, len(scans))
    localiser.finish()
    path, covariances, registered = localiser.path(), localiser.covariances(), localiser.registered
    if path is None or covariances is None or not registered.any():
        if localiser.ambiguous:
            raise InputError(
                "map: expected one that shows the place of this drive once, it is ambiguous: several places of the map "
                "look like it; a longer drive or a guess may help"
            )
        where = (
            "none was found" if guess is None else "the scans do not fit it at the guess, and elsewhere none was found"
        )
        raise InputError(
            f"map: expected one that shows a place of this drive, {where} in {localiser.way:.0f} m of way; a longer "
            "drive, or a guess good to a metre or two and 0.1 rad, may help"
        )
    trajectory = Trajectory(scans.timestamps, path @ inverse_transform(scans.ego_T_lidar))
    fit = localiser.consistency
    return LocalisedDrive(trajectory, covariances, registered, fit.misfits, fit.unjudged)


def write_localised(output: Path, found: LocalisedDrive, scans: ScanSequence, slam_map: SlamMap) -> dict[str, Any]:
    """Write all files, or none; returns the metrics."""
    truth, path = reference(scans), found.trajectory
    figures: dict[str, Any] = {
        "scans": len(scans),
        "registered": int(found.registered.sum()),
        "first_registered": int(np.argmax(found.registered)) if found.registered.any() else None,
        "misfits": dict(found.misfits),
        "unjudged": dict(found.unjudged),
    }
    if truth is not None:
        figures["trajectory"] = asdict(trajectory_errors(path, truth, "none"))
        figures["aligned"] = asdict(trajectory_errors(path, truth, "rigid"))
    points = placed_clouds(slam_map.points, slam_map.map_T_submap, 0.3)
    with atomic_directory(output, known=LIDAR_FILES) as folder:
        write_paths(folder, trajectory=path, reference=truth)
        registered, times = found.registered.astype(int).tolist(), path.timestamps.tolist()
        write_covariances(folder / "covariances.csv", "timestamp", times, found.covariances, registered=registered)
        drawn = {} if truth is None else {"reference": truth.positions}
        drawn["trajectory"] = path.positions
        write_bytes(folder / "above.png", png(scan_map_from_above(points, drawn, np.empty((0, 2)), {})))
        write_figures(folder / "metrics.json", figures)
    return figures
