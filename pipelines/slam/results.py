"""Results of SLAM as files, in a folder that is written whole or not at all.

All runs share the forms of these:

*.tum             a path in the TUM format; trajectory.txt in KITTI's
landmarks.json    each landmark: number, kind, coordinates (m), covariance of its tangent, number of observations
covariances.csv   of each pose: its name, then the upper triangle in the pose's own frame, rad and m: (x, y, heading) or
                  (rotation vector, translation)
tracks.csv        a row for each object and moment: timestamp (s), id, class, x, y (m), vx, vy (m/s) in world
                  coordinates, the standard deviations of the last four, and the probability of being stationary
above.png         the results from above

Results of SLAM with a planar laser.

trajectory.tum, matched.tum, odometry.tum   the path at every scan: the result, by scan matching alone, by the wheels
poses.g2o       keyframes and all measurements between them that were kept
map.png         occupancy, with the path; figures.json: counts, entropy of the map, time

Results of LiDAR SLAM on a recording.

trajectory.txt, times.txt   poses of the vehicle, KITTI's format: world_T_ego of every scan, and its time
trajectory.tum              the same in the TUM format
odometry.tum                by odometry alone; online.tum: as estimated when each scan came
covariances.csv             of the sensor's pose at the keyframes
map.ply                     the accumulated points of the keyframes, one a voxel, in world coordinates
reference.tum               the recording's own poses; evo_ape tum reference.tum trajectory.tum gives the error
map/                        the points of each submap and its place (`pipelines.slam.drive`)
graph.g2o                   poses as estimated, the first one's prior, odometry and loops as in the solution
observations.csv            keyframe, landmark, kind, value, covariance: all observations of landmarks of the map, value
                            as the kind has it (a wall nx ny nz d, a pole x y z), the covariance as its upper triangle
landmarks.json              each landmark; landmarks.csv: the same as a table, with shapes as WKT
tracks.csv                  objects, where there are any
above.png                   map, paths, landmarks and the objects' tracks from above
metrics.json                errors of the trajectories against the recording's own poses, scans that left motions
                            open, and sensors that do not fit or measured too little to tell

Files of points and landmarks are left out where there are none.

Results of localisation: the path in the map's frame (trajectory.tum, trajectory.txt with times.txt), reference.tum,
covariances.csv of the sensor's pose at each scan, and whether that was registered with the map, above.png, and in
metrics.json errors against the recording's poses, as they are and with the path aligned, and counts.

Results of several drives in one map, in the world of the first: paths/NAME.tum of each, map/, map.ply, graph.g2o of the
keyframes of all with the loops between them, above.png, and counts in metrics.json.

World coordinates are those of the recording (KITTI: x east, y north, z up, from the first pose).
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.figures import occupancy_picture, paths_from_above, png, scan_map_from_above, write_figures
from data_tools.files import atomic_directory, write_bytes, write_text
from data_tools.laser import LaserLog, OccupancyGrid
from data_tools.lidar import ScanSequence, write_cloud
from data_tools.pose_graphs import write_g2o
from data_tools.trajectories import Trajectory, trajectory_errors, write_kitti_poses, write_tum_poses
from pipelines.slam.drive import Origin, SlamMap, covariance_columns, placed_clouds, write_map
from pipelines.slam.driver import SlamResult
from pipelines.slam.laser_slam import LaserPath
from pipelines.slam.lidar_slam import WALL, LidarSlamSettings
from pipelines.slam.localisation import LocalisedDrive
from pipelines.slam.merging import MergedDrives
from saga_fg.numerics import FloatArray, IntArray, in_space, inverse_transform, transform_points, transforms
from saga_fg.slam.joint import JointEstimate
from saga_fg.slam.pose_graph import OptimisedPoses, PoseGraph
from saga_fg.types import Landmark

_CONFIRMED = 5  # detections


def landmark_rows(landmarks: Iterable[Landmark]) -> list[dict[str, Any]]:
    """Return the content of landmarks.json for a map."""
    return [
        {"number": mark.number, "kind": mark.kind.name, **mark.kind.coordinates(mark.state)}
        | {"covariance": mark.covariance.tolist(), "observations": mark.observations}
        for mark in landmarks
    ]


def write_covariances(
    path: Path, key: str, names: Sequence[object], covariances: FloatArray, **columns: Sequence[object]
) -> None:
    """Write covariances.csv: the covariance (N, k, k) of each pose, its name in column `key`; other columns follow."""
    upper = np.triu_indices(covariances.shape[1])
    rows = [",".join([key, *columns, *covariance_columns(covariances.shape[1])])]
    for *entries, covariance in zip(names, *columns.values(), covariances, strict=True):
        rows.append(",".join([*map(str, entries), *(f"{x:.9g}" for x in covariance[upper])]))
    write_text(path, "\n".join(rows) + "\n")


def confirmed_paths(estimate: JointEstimate) -> dict[int, FloatArray]:
    """Places (n, 2), m, from first to last, of objects that were detected `_CONFIRMED` times at least, by id.

    Pictures leave clutter out.
    """
    seen = [estimate.assignment(row).id for row in range(len(estimate.timestamps))]
    ids, counts = np.unique(np.concatenate(seen), return_counts=True)
    name, place = (np.concatenate([getattr(now, each) for now in estimate.objects]) for each in ("id", "position"))
    return {known: place[name == known] for known in ids[counts >= _CONFIRMED].tolist()}


def write_objects(path: Path, estimate: JointEstimate) -> None:
    """Write tracks.csv."""
    rows = ["timestamp,id,class,x,y,vx,vy,sigma_x,sigma_y,sigma_vx,sigma_vy,stationary"]
    for moment, (time, objects) in enumerate(zip(estimate.timestamps, estimate.objects, strict=True)):
        sigma = np.sqrt(np.diagonal(estimate.object_covariances(moment), axis1=1, axis2=2))
        table = np.column_stack([objects.position, objects.velocity, sigma, objects.stationary])
        rows += [
            f"{time:.6f},{name},{label}," + ",".join(f"{x:.4f}" for x in row)
            for name, label, row in zip(objects.id.tolist(), objects.label, table, strict=True)
        ]
    write_text(path, "\n".join(rows) + "\n")


def write_pose_graph(
    output: Path,
    graph: PoseGraph,
    optimised: OptimisedPoses,
    rows: IntArray,
    covariances: FloatArray,
    errors: Mapping[str, float],
    rejected: Sequence[str] = (),
) -> None:
    """Write poses.g2o, the graph with its optimised poses, and errors.json; rejected: measurements left out as false.

    covariances (n, k, k) of poses `rows` (n,), relative to the first one: covariances.csv, unless there are none
    errors: by name: of each start, of the guess itself, of the baselines where they were run
    """
    d, minimum = graph.dim, optimised.chordal
    figures: dict[str, object] = {"best": optimised.start, **errors, "rejected": list(rejected)}
    if minimum is not None:
        names = ("cost", "bound", "gap", "certified", "eigenvalue", "dimensions")
        figures["chordal"] = {name: getattr(minimum, name) for name in names}
    paths = {"guess": graph.world_T_pose[:, :d, d], "optimised": optimised.world_T_pose[:, :d, d]}
    best, points = graph.at(optimised.world_T_pose), {}
    if graph.landmarks is not None and optimised.landmarks is not None:
        best = best.with_landmarks(replace(graph.landmarks, position=optimised.landmarks))
        points = {"landmarks": optimised.landmarks}
    with atomic_directory(output, known=("covariances.csv",)) as folder:
        write_g2o(folder / "poses.g2o", best)
        if len(rows):
            write_covariances(folder / "covariances.csv", "id", graph.ids[rows].tolist(), covariances)
        write_figures(folder / "errors.json", figures)
        write_bytes(folder / "above.png", png(paths_from_above(paths, points)))


def write_laser_slam(
    output: Path, log: LaserLog, path: LaserPath, largest_range: float, seconds: float
) -> dict[str, float]:
    """Write the results, and return the figures. Poses are sorted by time; of two at one time the first is kept."""
    grid = _grid(log, path, path.poses, largest_range)
    lasted = float(log.time.max() - log.time.min())
    figures: dict[str, float] = {
        "scans": len(log),
        "keyframes": len(path.keyframes),
        "loops": path.loops,
        "false_loops": path.rejected,
        "jumps_of_the_wheels": path.jumps,
        "scale_of_the_wheels": path.wheel_scale,
        "entropy": grid.entropy,
        "entropy_scan_matching": _grid(log, path, path.matched, largest_range).entropy,
        "seconds": seconds,
        "times_real_time": lasted / seconds if seconds > 0 else np.inf,
    }
    _, first = np.unique(log.time, return_index=True)
    wheels = transforms(log.odometry)
    wheels = np.linalg.inv(wheels[0]) @ wheels
    with atomic_directory(output) as folder:
        for name, poses in (("trajectory", path.poses), ("matched", path.matched), ("odometry", wheels)):
            write_tum_poses(folder / f"{name}.tum", Trajectory(log.time[first], in_space(poses[first])))
        write_g2o(folder / "poses.g2o", path.graph)
        write_bytes(
            folder / "map.png", png(occupancy_picture(grid.probability, grid.origin, grid.cell, path.poses[:, :2, 2]))
        )
        write_figures(folder / "figures.json", figures)
    return figures


def _grid(log: LaserLog, path: LaserPath, poses: FloatArray, largest_range: float) -> OccupancyGrid:
    laser = transforms(log.robot_T_laser[None])[0]
    scans = [log.points(row, largest_range) for row in path.keyframes.tolist()]
    return OccupancyGrid.of(scans, poses[path.keyframes] @ laser)


# all that a run may write, also in a map of an earlier one: a folder holds the files of its last run
_MAP_FILES = ("map.ply", "map/submaps.csv", "map/origin.csv", "map/[0-9]*.ply", "map/[0-9]*.pcd", "graph.g2o")
LIDAR_FILES = (
    *("trajectory.txt", "times.txt", "trajectory.tum", "odometry.tum", "online.tum", "reference.tum"),
    *_MAP_FILES,
    *("observations.csv", "landmarks.json", "landmarks.csv"),
    *("covariances.csv", "tracks.csv", "above.png", "metrics.json"),
)
_GAP = 2.0  # m between observed spans of a wall, beyond which two pieces of it are drawn
_MOVES, _TELLING = 1.0, 10.0  # m/s; m travelled that tell where ahead is
_ONE_WAY, _SIDEWAYS = 0.9, 20.0  # length of the mean direction; deg off the axis
_log = logging.getLogger(__name__)


def metrics(result: SlamResult, scans: ScanSequence) -> dict[str, Any]:
    """Errors (start aligned) of the three trajectories against the recording's poses, if it has any; counts."""
    truth = reference(scans)
    paths = {name: getattr(result, name) for name in ("odometry", "online", "trajectory")}
    paths["without_objects"], kinds = result.alone, [landmark.kind.name for landmark in result.landmarks]
    return {
        "keyframes": len(result.keyframes),
        "landmarks": {name: kinds.count(name) for name in sorted(set(kinds))},
        "loops": len(result.loops),
        "false_loops": len(result.false_loops),
        "odometry_inflation": dict(zip(("rotation", "translation"), result.selection.inflation.tolist(), strict=True)),
        "submaps": len(result.submaps),
        "degenerate": degenerate_spans(result.trajectory.timestamps, result.degenerate),
        "misfits": {**result.misfits, **_misplaced(result.trajectory)},
        "unjudged": dict(result.unjudged),
        **{
            name: asdict(trajectory_errors(path, truth, "start"))
            for name, path in paths.items()
            if path is not None and truth is not None
        },
    }


def _misplaced(path: Trajectory) -> dict[str, str]:
    """The LiDAR, with a warning, where the vehicle moves one way throughout that is neither ahead nor backwards."""
    steps = (inverse_transform(path.world_T_ego[:-1]) @ path.world_T_ego[1:])[:, :3, 3]
    travelled = np.linalg.norm(steps, axis=1)
    moves = travelled > _MOVES * np.diff(path.timestamps)
    if travelled[moves].sum() < _TELLING:
        return {}
    mean = (steps[moves] / travelled[moves, None]).mean(axis=0)
    off = float(np.degrees(np.arccos(min(abs(mean[0]) / np.linalg.norm(mean), 1.0))))
    if np.linalg.norm(mean) < _ONE_WAY or off < _SIDEWAYS:
        return {}
    text = (
        f"lidar: the vehicle moves {off:.0f} deg off its axis ahead throughout: check where the LiDAR is mounted "
        "(--mount, /tf), unless it is carried"
    )
    _log.warning(text)
    return {"lidar": text}


def reference(scans: ScanSequence) -> Trajectory | None:
    """The recording's own poses; None where it has none."""
    return None if scans.world_T_ego is None else Trajectory(scans.timestamps, scans.world_T_ego)


def degenerate_spans(times: FloatArray, degenerate: Sequence[tuple[str, ...]]) -> list[dict[str, Any]]:
    """Runs of scans that leave the same motions open: first and last scan, their times, s, and the motions in words."""
    spans = list[dict[str, Any]]()
    for motions, run in groupby(range(len(degenerate)), key=degenerate.__getitem__):
        rows = list(run)
        begin, end = times[[rows[0], rows[-1]]].tolist()
        spans.append({"first": rows[0], "last": rows[-1], "from": begin, "until": end, "motions": list(motions)})
    return [span for span in spans if span["motions"]]


def write_lidar_slam(
    output: Path,
    result: SlamResult,
    scans: ScanSequence,
    settings: LidarSlamSettings | None = None,
    origin: Origin | None = None,
) -> dict[str, Any]:
    """Write all files of a run to a folder, or none; returns the metrics.

    settings: of the run, with the spacing of the map's points; origin: of the world, on Earth
    """
    s = settings or LidarSlamSettings()
    clouds, objects = [submap.points for submap in result.submaps], result.objects
    points = placed_clouds(clouds, result.world_T_submap, s.map_spacing)
    lines = {mark.number: _seen_pieces(result, mark) for mark in result.landmarks if mark.kind == WALL}
    figures, truth = metrics(result, scans), reference(scans)
    if objects is not None:
        figures["objects"] = len(np.unique(np.concatenate([now.id for now in objects.objects])))
    with atomic_directory(output, known=LIDAR_FILES) as folder:
        given = {name: getattr(result, name) for name in ("trajectory", "odometry", "online")}
        write_paths(folder, **given, reference=truth)
        if len(points):
            (folder / "map").mkdir()
            write_map(folder / "map", SlamMap(clouds, result.world_T_submap, origin))
            write_cloud(folder / "map.ply", points)
        write_graph(folder, result)
        times = result.trajectory.timestamps[result.keyframes].tolist()
        write_covariances(folder / "covariances.csv", "timestamp", times, result.covariances)
        if result.landmarks:
            write_figures(folder / "landmarks.json", landmark_rows(result.landmarks))
            write_landmark_table(folder / "landmarks.csv", result.landmarks, lines)
        paths = {} if truth is None else {"reference": truth.positions}
        paths["trajectory"] = result.trajectory.positions
        if objects is not None:
            write_objects(folder / "tracks.csv", objects)
        driven = () if objects is None else tuple(confirmed_paths(objects).values())
        walls = {"walls": np.concatenate([np.empty((0, 2, 2)), *lines.values()])}
        figure = scan_map_from_above(points, paths, _poles(result.landmarks), walls, driven)
        write_bytes(folder / "above.png", png(figure))
        write_figures(folder / "metrics.json", figures)
    return figures


def write_paths(folder: Path, trajectory: Trajectory, **others: Trajectory | None) -> None:
    """Write each path as NAME.tum, and `trajectory` in KITTI's format besides."""
    write_kitti_poses(folder / "trajectory.txt", trajectory, folder / "times.txt")
    for name, path in {"trajectory": trajectory, **others}.items():
        if path is not None:
            write_tum_poses(folder / f"{name}.tum", path)


def _poles(landmarks: Sequence[Landmark]) -> FloatArray:
    """Places (P, 2) of all but walls."""
    places = [mark.kind.coordinates(mark.state) for mark in landmarks if mark.kind != WALL]
    return np.array([[place["x"], place["y"]] for place in places], dtype=np.float64).reshape(-1, 2)


def _seen_pieces(result: SlamResult, mark: Landmark) -> FloatArray:
    """Ends (n, 2, 2) of the pieces of a wall that were observed."""
    place = mark.kind.coordinates(mark.state)
    normal = np.array([place["nx"], place["ny"]]) / np.hypot(place["nx"], place["ny"])
    along = np.array([-normal[1], normal[0]])
    foot = (np.array([place["x"], place["y"]]) @ normal) * normal
    spans = []
    for pose, now in zip(result.world_T_lidar, result.observations, strict=True):
        for extent in (one.extent for number, one in now if number == mark.number and one.extent is not None):
            u = transform_points(pose, extent)[:, :2] @ along
            spans.append((float(u.min()), float(u.max())))
    pieces = [np.stack([foot + low * along, foot + high * along]) for low, high in covered_spans(spans)]
    return np.array(pieces).reshape(-1, 2, 2)


def covered_spans(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the union of spans, gaps up to `_GAP` filled: houses on both sides of a street may lie in one plane."""
    covered: list[tuple[float, float]] = []
    for low, high in sorted(spans):
        if covered and low <= covered[-1][1] + _GAP:
            covered[-1] = (covered[-1][0], max(high, covered[-1][1]))
        else:
            covered.append((low, high))
    return covered


def write_landmark_table(path: Path, landmarks: Iterable[Landmark], pieces: Mapping[int, FloatArray]) -> None:
    """Write number, kind, observations, standard deviations of the state, and the geometry as WKT, in x and y, m.

    pieces: (n, 2, 2) ends of what was seen of walls, by the number of the landmark; others are points
    """
    rows = ["number,kind,observations,deviations,geometry"]
    for mark in landmarks:
        deviations = " ".join(f"{x:.4g}" for x in np.sqrt(np.diag(mark.covariance)))
        if mark.number in pieces:
            lines = ", ".join(f"({', '.join(f'{x:.3f} {y:.3f}' for x, y in ends)})" for ends in pieces[mark.number])
            shape = f"MULTILINESTRING ({lines})" if lines else "MULTILINESTRING EMPTY"
        else:
            place = mark.kind.coordinates(mark.state)
            shape = f"POINT ({place['x']:.3f} {place['y']:.3f})" if "x" in place else "POINT EMPTY"
        rows.append(f'{mark.number},{mark.kind.name},{mark.observations},{deviations},"{shape}"')
    write_text(path, "\n".join(rows) + "\n")


_OBSERVED = ("keyframe", "landmark", "kind", "value", "covariance")


def write_graph(folder: Path, result: SlamResult) -> None:
    """Write graph.g2o and observations.csv to a folder that exists; a graph of one keyframe is none."""
    if len(result.keyframes) < 2:
        return
    write_g2o(folder / "graph.g2o", result.pose_graph())
    marks = {mark.number for mark in result.landmarks}
    rows = [",".join(_OBSERVED)]
    for keyframe, now in enumerate(result.observations):
        for number, one in now:
            if number in marks:
                fields = (one.value, one.covariance[np.triu_indices(len(one.covariance))])
                value, covariance = (" ".join(f"{x:.17g}" for x in field) for field in fields)
                rows.append(f"{keyframe},{number},{one.kind.name},{value},{covariance}")
    write_text(folder / "observations.csv", "\n".join(rows) + "\n")


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


MERGED_FILES = ("paths/*.tum", *_MAP_FILES, "above.png", "metrics.json")


def write_merged(output: Path, merged: MergedDrives, spacing: float) -> dict[str, Any]:
    """Write all files, or none; returns the metrics. spacing: of the points of map.ply, m."""
    slam_map, names = merged.slam_map, [one.name for one in merged.sessions]
    points = placed_clouds(slam_map.points, slam_map.map_T_submap, spacing)
    paths = dict(zip(names, (one.path for one in merged.sessions), strict=True))
    figures: dict[str, Any] = {
        "drives": names,
        "keyframes": [len(one.graph) for one in merged.sessions],
        "submaps": len(slam_map.points),
        "loops_between": len(merged.loops),
        "false_loops_between": len(merged.false_loops),
    }
    with atomic_directory(output, known=MERGED_FILES) as folder:
        for sub in ("paths", "map"):
            (folder / sub).mkdir()
        for name, path in paths.items():
            write_tum_poses(folder / "paths" / f"{name}.tum", path)
        write_map(folder / "map", slam_map)
        write_cloud(folder / "map.ply", points)
        write_g2o(folder / "graph.g2o", merged.graph)
        drawn = {name: path.positions for name, path in paths.items()}
        write_bytes(folder / "above.png", png(scan_map_from_above(points, drawn, np.empty((0, 2)), {})))
        write_figures(folder / "metrics.json", figures)
    return figures
