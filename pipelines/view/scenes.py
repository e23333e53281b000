"""Results as drawings: shapes in frames at times, of boxes and tracks, paths and maps of SLAM.

    scenes.py -> `Drawing`s in order of time -> writers.py

Frames are a tree of names: `Drawing(frame="scene/ego", name="lidar", shape=Pose(...))` says where the frame
`scene/ego/lidar` is in `scene/ego`. A drawing replaces the one before it of the same name.

A scene and its tracks as drawings, at times from the scene's start (its first moment or scan).

    NAME/ego                 the vehicle, a moving frame; NAME/ego/body: its box
    NAME/ego/lidar           a frame; NAME/ego/lidar/points: the points of its scans
    NAME/ego_path            where it drives
    NAME/detections          boxes of all sensors since the moment before
    NAME/truth/{seen,hidden} true boxes with their ids
    NAME/METHOD/boxes        of the tracks, with ids, classes and scores
    NAME/METHOD/trajectories their paths of the last seconds
    NAME/METHOD/velocities   arrows of one second
    NAME/METHOD/ellipses     that hold the true centre with 90 % in the plane, if the covariance is right
    NAME/METHOD/edges        lines from source to target, the thicker the higher the rate
    NAME/graph/nodes         variables of the running graph with their names, earlier ones 2 m below, if there is a
                             journal of the run
    NAME/graph/KIND          lines from each factor of a kind to its variables

Metres about the vehicle's first place, z up: viewers count in float32. All layers of a moment are drawn at its time,
so that none outlives it.

Results of `saga-fg slam scans` as drawings: paths, the map, landmarks with their names.

    ROOT/trajectory, ROOT/odometry, ROOT/online   paths, those that are there
    ROOT/pose                                     a moving frame along the trajectory; ROOT/pose/body: the vehicle
    ROOT/map                                      points of map.ply
    ROOT/names                                    kind and number of landmarks with a place (planes have none)

Metres, about `origin`.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_tools.datasets.source import DatasetSource
from data_tools.figures import COLOURS, class_colours
from data_tools.files import parsed_json, read_bytes
from data_tools.lidar import Scan, ScanSequence, read_scan, voxel_downsample
from data_tools.metrics import SceneBoxes
from data_tools.trajectories import Trajectory, read_tum_poses
from pipelines.report import UNMEASURED, Edges, ReportScene, edges_of_frames, latest_detections, result_scenes
from saga_fg import Boxes, InputError
from saga_fg.numerics import FloatArray, IntArray, checked

if TYPE_CHECKING:
    from pipelines.slam.driver import Slam, SlamStep

VEHICLE = (4.6, 1.9, 1.6)  # length, width, height of the box drawn for the vehicle, m
Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255. Shapes have one of them for all, (1, 3), or one each, (N, 3)."""
Facts = Mapping[str, Sequence[str]]
"""Columns of texts by name, a row for each thing; the first column holds their identifiers."""


@dataclass(frozen=True, eq=False)
class Solids:
    """N boxes, or ellipsoids if `round`: centre and size (N, 3), m, yaw (N,), rad; facts of each, or none.

    size: length, width, height
    """

    centre: FloatArray
    size: FloatArray
    yaw: FloatArray
    colour: IntArray
    facts: Facts = field(default_factory=dict)
    round: bool = False

    @property
    def labels(self) -> list[str]:
        """The facts of each solid in a line; empty without facts."""
        return [" ".join(row) for row in zip(*self.facts.values(), strict=True)]


@dataclass(frozen=True, eq=False)
class Lines:
    """N strips of points (n, 3), m; radius (1,) or (N,), m."""

    strips: Sequence[FloatArray]
    colour: IntArray
    radius: FloatArray


@dataclass(frozen=True, eq=False)
class Arrows:
    """N arrows from their tail (N, 3), m, along a vector (N, 2) in the plane, m."""

    tail: FloatArray
    vector: FloatArray
    colour: IntArray
    radius: float


@dataclass(frozen=True, eq=False)
class Points:
    """N points (N, 3), m, drawn with a radius, m; with their names, or a cloud without."""

    points: FloatArray
    colour: IntArray
    radius: float
    names: Sequence[str] | None = None


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose (4, 4) of a frame in its parent."""

    parent_T_child: FloatArray


Shape = Solids | Lines | Arrows | Points | Pose


@dataclass(frozen=True, eq=False)
class Drawing:
    """A shape in a frame.

    frame   frame of the shape's coordinates
    name    of the layer, below that of the frame; of a pose: of the frame that it places
    time    s from the start, None for a static shape
    moment  row of the scene's moment, if it belongs to one
    """

    frame: str
    name: str
    shape: Shape
    time: float | None = None
    moment: int | None = None

    @property
    def path(self) -> str:
        """The name with the names of all frames above it."""
        return f"{self.frame}/{self.name}"


def in_order(*drawings: Iterable[Drawing]) -> Iterator[Drawing]:
    """Merge sequences of drawings, each in order of time; static ones come first."""
    return heapq.merge(*drawings, key=lambda each: -np.inf if each.time is None else each.time)


def one_colour(colour: Colour) -> IntArray:
    """Return a colour for all shapes, (1, 3)."""
    return np.array([colour], dtype=np.int64)


HISTORY = 4.0  # s, of trajectories
FLAT = 0.04  # m, height of an ellipse
SUNK = 2.0  # m, earlier states below the newest ones
HELD = 2 * np.log(10.0)  # squared sigmas of the ellipse that holds 90 % in the plane
DETECTION, SEEN, HIDDEN, PATH, EDGE, POINT, NODE = map(
    one_colour,
    ((140, 140, 140), (60, 180, 75), (30, 90, 38), (90, 90, 200), (250, 190, 60), (200, 200, 200), (230, 230, 230)),
)


@dataclass(frozen=True, eq=False)
class SceneView:
    """A scene with results, and its LiDAR scans if there are any; their points are thinned to `spacing`, m.

    graphs  of the frames, from the journal of the run (`saga_fg.tracking.journal`)
    """

    report: ReportScene
    scans: ScanSequence | None = None
    spacing: float = 0.1
    graphs: Sequence[Mapping[str, Any]] = ()


def result_views(source: DatasetSource, result: Path, spacing: float) -> list[SceneView]:
    """Read the scenes of the result of any tracker; points are thinned to `spacing` m, 0 leaves them out.

    Raises `InputError` for missing or broken files, and for a result that does not fit the dataset.
    """
    scenes = result_scenes(source, result, source.read_results(result))
    around = source.surroundings({each.scene.name: each.scene for each in scenes})
    scans = around.scans() if spacing else {}
    return [SceneView(each, scans.get(each.scene.name), spacing) for each in scenes]


def draw_scene(view: SceneView) -> Iterator[Drawing]:
    """Draw a scene in order of time, in the frame of its name."""
    scene, root = view.report.scene, view.report.scene.name
    origin = scene.world_T_ego[0, :3, 3] if len(scene) else np.zeros(3)
    path = scene.world_T_ego[:, :3, 3] - origin
    centre = np.array([[VEHICLE[0] / 2 - 1.0, 0.0, VEHICLE[2] / 2]])
    yield Drawing(root, "ego_path", Lines([path] if len(path) else [], PATH, np.array([0.05])))
    yield Drawing(f"{root}/ego", "body", Solids(centre, np.array([VEHICLE]), np.zeros(1), PATH, {"id": ["ego"]}))
    scans = view.scans if view.scans is not None and len(view.scans) else None
    start = min(
        [*scene.timestamps[:1].tolist(), *(scans.timestamps[:1].tolist() if scans is not None else ())], default=0
    )
    if scans is not None:
        yield Drawing(f"{root}/ego", "lidar", Pose(scans.ego_T_lidar))
    points = () if scans is None else _scans(root, scans, start, view.spacing)
    yield from in_order(_drawn_moments(view.report, origin, start), points, _graphs(view, origin, start))


def _drawn_moments(report: ReportScene, origin: FloatArray, start: float) -> Iterator[Drawing]:
    scene, root = report.scene, report.scene.name
    detections, _ = latest_detections(scene, report.sensors)
    methods = {name: _Method(table, origin, report) for name, table in report.tracks.items()}
    edges = {name: edges_of_frames(table, len(scene), report.rules) for name, table in report.tracks.items()}
    for k, time in enumerate((scene.timestamps - start).tolist()):
        pose = scene.world_T_ego[k].copy()
        pose[:3, 3] -= origin
        yield Drawing(root, "ego", Pose(pose), time, k)
        if scene.frames:
            yield Drawing(root, "detections", _boxes(detections[k], origin, DETECTION), time, k)
        if scene.ground_truth is not None:
            truth = scene.ground_truth[k]
            for name, rows, colour in (("seen", truth.visible, SEEN), ("hidden", ~truth.visible, HIDDEN)):
                boxes = _boxes(truth.boxes.select(rows), origin, colour, {"id": truth.id[rows].tolist()})
                yield Drawing(root, f"truth/{name}", boxes, time, k)
        for name, method in methods.items():
            for layer, shape in method.at(k, next(edges[name])):
                yield Drawing(root, f"{name}/{layer}", shape, time, k)


def _scans(root: str, scans: ScanSequence, start: float, spacing: float) -> Iterator[Drawing]:
    for k, time in enumerate((scans.timestamps - start).tolist()):
        points = scans[k].points
        points = points[voxel_downsample(points, spacing)]
        yield Drawing(f"{root}/ego/lidar", "points", Points(points, POINT, 0.03), time)


def _graphs(view: SceneView, origin: FloatArray, start: float) -> Iterator[Drawing]:
    """Draw the running graph of each frame. Raises `InputError` for records that are no graph."""
    root, moments = (
        view.report.scene.name,
        {round(t, 3): k for k, t in enumerate(view.report.scene.timestamps.tolist())},
    )
    try:
        shapes = [_graph(graph, origin) for graph in view.graphs]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{root}: expected graphs as --explain writes them: {error!r:.80}") from error
    kinds = sorted({kind for _, lines in shapes for kind in lines})
    for graph, (marks, lines) in zip(view.graphs, shapes, strict=True):
        when = float(graph["time"]) - start, moments.get(round(graph["time"], 3))
        yield Drawing(root, "graph/nodes", marks, *when)
        for number, kind in enumerate(kinds):
            colour = one_colour(rgb(COLOURS[number % len(COLOURS)]))
            shape = Lines(lines.get(kind, []), colour, np.array([0.05]))
            yield Drawing(root, f"graph/{re.sub('[^A-Za-z0-9]+', '_', kind)}", shape, *when)


def _graph(graph: Mapping[str, Any], origin: FloatArray) -> tuple[Points, dict[str, list[FloatArray]]]:
    """Return variables, and by kind lines from the middle of each factor to its variables, up from a single one."""
    nodes = graph["nodes"]
    newest = max((node["time"] for node in nodes if node["time"] is not None), default=None)
    depth = [0.0 if node["time"] in (newest, None) else -SUNK for node in nodes]
    places = np.array([[*node["position"], z] for node, z in zip(nodes, depth, strict=True)]).reshape(-1, 3)
    places[:, :2] -= origin[:2]
    lines: dict[str, list[FloatArray]] = {}
    for factor in graph["factors"]:
        ends = places[factor["nodes"]]
        middle = ends[:2].mean(axis=0) if len(ends) > 1 else ends[0] + [0.0, 0.0, SUNK]
        for n, end in enumerate(ends):
            acting = n >= 2 and "edges" in factor
            kind = f"{factor['kind']} {factor['edges'][n - 2][0]}" if acting else factor["kind"]
            lines.setdefault(kind, []).append(np.stack([middle, end]))
    return Points(places, NODE, 0.25, [node["name"] for node in nodes]), lines


class _Method:
    """The tracks of one method."""

    def __init__(self, table: SceneBoxes, origin: FloatArray, report: ReportScene) -> None:
        self._table, self._place = table, table.boxes.position - origin
        self._origin, self._time = origin, report.scene.timestamps
        self._number = np.unique(table.id, return_inverse=True)[1]
        labels = {label for each in report.tracks.values() for label in each.boxes.label.tolist()}
        colours = class_colours(sorted(labels))
        self._colour = np.array([rgb(colours[label]) for label in table.boxes.label.tolist()]).reshape(-1, 3)

    def at(self, moment: int, edges: Edges) -> Iterator[tuple[str, Shape]]:
        """Yield the layers of a moment with their shapes."""
        table, place = self._table, self._place
        rows = np.flatnonzero(table.frame == moment)
        colour = self._colour[rows]
        boxes = table.boxes.select(rows)
        facts = {
            "id": table.id[rows].tolist(),
            "class": boxes.label.tolist(),
            "score": [f"{score:.2f}" for score in table.score[rows].tolist()],
        }
        yield "boxes", _boxes(boxes, self._origin, colour, facts)
        yield "trajectories", Lines(self._trajectories(moment, rows), colour, np.array([0.05]))
        yield "velocities", Arrows(place[rows], np.nan_to_num(boxes.velocity), colour, 0.08)
        known = np.isfinite(table.position_covariance[rows]).all(axis=(1, 2))
        size, yaw = ellipses(table.position_covariance[rows[known]])
        yield "ellipses", Solids(place[rows[known]], size, yaw, colour[known], round=True)
        target, source, rate, _ = edges
        strips = np.stack([place[source], place[target]], axis=1)
        yield "edges", Lines(list(strips), EDGE, 0.05 + 0.1 * np.minimum(rate, 2.0))

    def _trajectories(self, moment: int, rows: IntArray) -> list[FloatArray]:
        """Return the places (n, 3) of the tracks of `rows` in the last seconds."""
        first = np.searchsorted(self._time, self._time[moment] - HISTORY)
        window = np.arange(*np.searchsorted(self._table.frame, [first, moment + 1]))
        window = window[np.argsort(self._number[window], kind="stable")]
        numbers = self._number[window]
        bounds = [np.searchsorted(numbers, self._number[rows], side) for side in ("left", "right")]
        return [self._place[window[a:b]] for a, b in zip(*(b.tolist() for b in bounds), strict=True)]


def ellipses(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the size (N, 3), m, and the yaw (N,) of flat 90 % ellipses of covariances (N, 2, 2)."""
    variance, axes = np.linalg.eigh(covariance)
    size = np.column_stack([2 * np.sqrt(HELD * np.maximum(variance, 0.0)), np.full(len(variance), FLAT)])
    return size, np.arctan2(axes[:, 1, 0], axes[:, 0, 0])


def rgb(colour: str) -> Colour:
    """Return a colour that is given as #rrggbb."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def _boxes(boxes: Boxes, origin: FloatArray, colour: IntArray, facts: Facts | None = None) -> Solids:
    size = np.where(np.isfinite(boxes.size), boxes.size, UNMEASURED)
    return Solids(boxes.position - origin, size, np.nan_to_num(boxes.yaw), colour, facts or {})


PATHS = {
    "trajectory": one_colour((90, 90, 200)),
    "odometry": one_colour((200, 120, 60)),
    "online": one_colour((120, 180, 120)),
}
MAP, LANDMARK = one_colour((130, 130, 130)), one_colour((240, 100, 40))


@dataclass(frozen=True, eq=False)
class SlamView:
    """paths: trajectories by name; points: (N, 3) of the map, None without it; names, places (M, 3) of landmarks.

    A landmark known in the plane alone is at height 0.
    """

    paths: Mapping[str, Trajectory]
    points: FloatArray | None
    names: tuple[str, ...]
    places: FloatArray


def read_slam_view(folder: Path) -> SlamView:
    """Read the files of a run of SLAM. Raises `InputError` for a folder without trajectory.tum and for broken files."""
    if not (folder / "trajectory.tum").is_file():
        raise InputError(f"{folder}: expected trajectory.tum, as `saga-fg slam scans` writes")
    paths = {name: read_tum_poses(file) for name in PATHS if (file := folder / f"{name}.tum").is_file()}
    points = read_scan(file).points if (file := folder / "map.ply").is_file() else None
    names, places = _named(folder / "landmarks.json")
    return SlamView(paths, points, names, places)


def draw_slam(view: SlamView, root: str, origin: FloatArray | None = None) -> Iterator[Drawing]:
    """Draw a run in the frame `root`; origin (3,) in its coordinates, the first pose if None.

    Times count from the first pose.
    """
    trajectory = view.paths["trajectory"]
    origin = trajectory.positions[0] if origin is None else origin
    for name, path in view.paths.items():
        yield Drawing(root, name, Lines([path.positions - origin], PATHS[name], np.array([0.08])))
    if view.points is not None:
        yield Drawing(root, "map", Points(view.points - origin, MAP, 0.03))
    if view.names:
        yield Drawing(root, "names", Points(view.places - origin, LANDMARK, 0.15, view.names))
    body = Solids(np.zeros((1, 3)), np.array([VEHICLE]), np.zeros(1), PATHS["trajectory"])
    yield Drawing(f"{root}/pose", "body", body)
    times = trajectory.timestamps - trajectory.timestamps[0]
    for time, world_T_ego in zip(times.tolist(), trajectory.world_T_ego, strict=True):
        pose = world_T_ego.copy()
        pose[:3, 3] -= origin
        yield Drawing(root, "pose", Pose(pose), time)


_LIVE = 0.3  # m, spacing of the points of a scan and a submap that are drawn while SLAM runs


def draw_slam_step(slam: Slam, scan: Scan, time: float, step: SlamStep) -> Iterator[Drawing]:
    """Draw a scan that `slam` has just placed, `time` s after the first: pose, points, the submap that it closed, and
    loops, which move all submaps."""
    place, submaps = step.world_T_lidar[None, :3, 3], slam.submaps
    yield Drawing("slam", "pose", Pose(step.world_T_lidar), time)
    yield Drawing("slam/pose", "scan", Points(scan.points[voxel_downsample(scan.points, _LIVE)], SEEN, 0.05), time)
    yield Drawing("slam", f"path/{time:.3f}", Points(place, PATHS["online"], 0.15), time)
    if step.submap is not None:
        points = step.submap.points.astype(np.float64)
        shown = Points(points[voxel_downsample(points, _LIVE)], MAP, 0.03)
        yield Drawing(f"slam/submap {len(submaps) - 1}", "points", shown, time)
        for number, submap in enumerate(submaps):
            world_T_submap = slam.keyframe(submap.keyframes[0]) @ submap.anchor_T_submap
            yield Drawing("slam", f"submap {number}", Pose(world_T_submap), time)
    for loop in step.loops:
        ends = np.array([slam.keyframe(k)[:3, 3] for k in (loop.first, loop.second)])
        yield Drawing("slam", f"loops/{loop.first}-{loop.second}", Lines([ends], EDGE, np.array([0.1])), time)


def _named(path: Path) -> tuple[tuple[str, ...], FloatArray]:
    """Return kind and number of each landmark with a place, and the places (M, 3)."""
    if not path.is_file():
        return (), np.empty((0, 3))
    rows = parsed_json(read_bytes(path), str(path))
    try:
        marks = [row for row in rows if "nx" not in row]
        names = tuple(f"{row['kind']} {row['number']}" for row in marks)
        places = np.array([[row["x"], row["y"], row.get("z", 0.0)] for row in marks], dtype=np.float64)
        return names, checked("places", places.reshape(-1, 3), (len(names), 3))
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected a list of landmarks with x, y: {error!r}") from error
