"""A scene and its tracks as rerun's entities, on the timeline `time` (s from the scene's start) and `moment`.

    NAME/ego                 the vehicle, a moving frame; NAME/ego/lidar: the points of its scans
    NAME/ego_path            where it drives
    NAME/detections          boxes of all sensors since the moment before
    NAME/truth/{seen,hidden} true boxes with their ids
    NAME/METHOD/boxes        of the tracks, with ids, classes and scores
    NAME/METHOD/trails       where they were in the last seconds
    NAME/METHOD/velocities   arrows of one second
    NAME/METHOD/ellipses     that hold the true centre with 90 % in the plane, if the covariance is right
    NAME/METHOD/edges        lines from source to target, the thicker the higher the rate

Metres about the vehicle's first place, z up: rerun counts in float32. All rows of a moment are logged at it, so that
nothing outlives its moment.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_tools.lidar import voxel_downsample
from data_tools.metrics import TrackTable
from pipelines.report.edges import Edges, edges_of_moments
from pipelines.report.scenes import UNMEASURED, ReportScene, latest_detections
from pipelines.scan_sequence import ScanSequence
from pipelines.view.stream import load_rerun
from saga_fg.arrays import FloatArray, IntArray
from saga_fg.boxes import Boxes

TRAIL = 4.0  # s
HELD = 2 * np.log(10.0)  # squared sigmas of the ellipse that holds 90 % in the plane
VEHICLE = (4.6, 1.9, 1.6)  # length, width, height of the box drawn for the vehicle, m
Colour = tuple[int, int, int]
DETECTION, SEEN, HIDDEN, PATH, EDGE = (140, 140, 140), (60, 180, 75), (30, 90, 38), (90, 90, 200), (250, 190, 60)


@dataclass(frozen=True, eq=False)
class SceneView:
    """A scene with results, and its LiDAR scans if there are any; their points are thinned to `spacing`, m."""

    report: ReportScene
    scans: ScanSequence | None = None
    spacing: float = 0.1


def log_scene(stream: Any, view: SceneView) -> None:
    """Log all of it to a `rerun.RecordingStream`, below the scene's name."""
    rerun = load_rerun()
    scene, root = view.report.scene, view.report.scene.name
    origin = scene.world_T_ego[0, :3, 3] if len(scene) else np.zeros(3)
    stream.log(root, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    path = (scene.world_T_ego[:, :3, 3] - origin) if len(scene) else np.zeros((0, 3))
    stream.log(f"{root}/ego_path", rerun.LineStrips3D([path], colors=[PATH]), static=True)
    centre = [VEHICLE[0] / 2 - 1.0, 0.0, VEHICLE[2] / 2]
    stream.log(
        f"{root}/ego/body", rerun.Boxes3D(centers=[centre], sizes=[VEHICLE], colors=[PATH], labels=["ego"]), static=True
    )
    detections, _ = latest_detections(scene, view.report.sensors)
    drawn = {name: _Method(name, table, origin, view.report) for name, table in view.report.tracks.items()}
    edges = {name: edges_of_moments(table, len(scene), view.report.rules) for name, table in view.report.tracks.items()}
    for k, time in enumerate((scene.timestamps - scene.timestamps[:1]).tolist()):
        stream.set_time("time", duration=time)
        stream.set_time("moment", sequence=k)
        pose = scene.world_T_ego[k]
        stream.log(f"{root}/ego", rerun.Transform3D(translation=pose[:3, 3] - origin, mat3x3=pose[:3, :3]))
        if scene.frames:
            stream.log(f"{root}/detections", _boxes(detections[k], origin, DETECTION))
        if scene.ground_truth is not None:
            truth = scene.ground_truth[k]
            for name, rows, colour in (("seen", truth.visible, SEEN), ("hidden", ~truth.visible, HIDDEN)):
                labels = truth.id[rows].tolist()
                stream.log(f"{root}/truth/{name}", _boxes(truth.boxes.select(rows), origin, colour, labels))
        for name, method in drawn.items():
            for entity, archetype in method.at(k, next(edges[name])):
                stream.log(f"{root}/{entity}", archetype)
    if view.scans is not None:
        _log_scans(stream, f"{root}/ego/lidar", view.scans, float(scene.timestamps[0]), view.spacing)


class _Method:
    """The tracks of one method."""

    def __init__(self, name: str, table: TrackTable, origin: FloatArray, report: ReportScene) -> None:
        self._name, self._table, self._place = name, table, table.boxes.position - origin
        self._origin, self._time = origin, report.scene.timestamps
        names, self._number = np.unique(table.id, return_inverse=True)
        self._colour = np.array([colour_of(k) for k in range(len(names))], dtype=np.uint8).reshape(-1, 3)

    def at(self, moment: int, edges: Edges) -> Iterator[tuple[str, Any]]:
        """(entity, archetype) of all there is to draw at a moment."""
        rerun = load_rerun()
        table, place = self._table, self._place
        rows = np.flatnonzero(table.moment == moment)
        colour = self._colour[self._number[rows]]
        boxes = table.boxes.select(rows)
        labels = [
            f"{id_} {label} {score:.2f}"
            for id_, label, score in zip(
                table.id[rows].tolist(), boxes.label.tolist(), table.score[rows].tolist(), strict=True
            )
        ]
        yield f"{self._name}/boxes", _boxes(boxes, self._origin, colour, labels)
        yield f"{self._name}/trails", rerun.LineStrips3D(self._trails(moment, rows), colors=colour, radii=[0.05])
        velocity = np.column_stack([np.nan_to_num(boxes.velocity), np.zeros(len(rows))])
        yield (
            f"{self._name}/velocities",
            rerun.Arrows3D(vectors=velocity, origins=place[rows], colors=colour, radii=[0.08]),
        )
        known = np.isfinite(table.position_covariance[rows]).all(axis=(1, 2))
        half, quaternion = ellipses(table.position_covariance[rows[known]])
        yield (
            f"{self._name}/ellipses",
            rerun.Ellipsoids3D(
                centers=place[rows[known]], half_sizes=half, quaternions=quaternion, colors=colour[known]
            ),
        )
        target, source, rate = edges
        strips = np.stack([place[source], place[target]], axis=1)
        yield f"{self._name}/edges", rerun.LineStrips3D(strips, radii=0.05 + 0.1 * np.minimum(rate, 2.0), colors=[EDGE])

    def _trails(self, moment: int, rows: IntArray) -> list[FloatArray]:
        """The places (n, 3) of each of the tracks of `rows` in the last seconds."""
        first = np.searchsorted(self._time, self._time[moment] - TRAIL)
        window = np.arange(*np.searchsorted(self._table.moment, [first, moment + 1]))
        window = window[np.argsort(self._number[window], kind="stable")]
        numbers = self._number[window]
        bounds = [np.searchsorted(numbers, self._number[rows], side) for side in ("left", "right")]
        return [self._place[window[a:b]] for a, b in zip(*(b.tolist() for b in bounds), strict=True)]


def ellipses(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Half axes (N, 3), m, and quaternions (N, 4), x y z w, of flat ellipsoids that hold 90 %; covariance (N, 2, 2)."""
    variance, axes = np.linalg.eigh(covariance)
    half = np.column_stack([np.sqrt(HELD * np.maximum(variance, 0.0)), np.full(len(covariance), 0.02)])
    return half, _about_z(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))


def colour_of(number: int) -> Colour:
    """A colour for the track of a number; neighbours differ (the hues step by the golden ratio)."""
    red, green, blue = colorsys.hsv_to_rgb(number * 0.618034 % 1.0, 0.65, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def _boxes(boxes: Boxes, origin: FloatArray, colour: Colour | Any, labels: list[str] | None = None) -> Any:
    size = np.where(np.isfinite(boxes.size), boxes.size, UNMEASURED)
    return load_rerun().Boxes3D(
        centers=boxes.position - origin,
        half_sizes=size / 2,
        quaternions=_about_z(np.nan_to_num(boxes.yaw)),
        colors=[colour] if isinstance(colour, tuple) else colour,
        labels=labels,
        show_labels=False,
    )


def _about_z(angle: FloatArray) -> FloatArray:
    """Quaternions (N, 4), x y z w, of rotations about z."""
    zero = np.zeros(len(angle))
    return np.column_stack([zero, zero, np.sin(angle / 2), np.cos(angle / 2)])


def _log_scans(stream: Any, entity: str, scans: ScanSequence, start: float, spacing: float) -> None:
    rerun = load_rerun()
    ego_T_lidar = scans.ego_T_lidar
    stream.log(entity, rerun.Transform3D(translation=ego_T_lidar[:3, 3], mat3x3=ego_T_lidar[:3, :3]), static=True)
    stream.reset_time()
    for k, time in enumerate(scans.timestamps.tolist()):
        stream.set_time("time", duration=time - start)
        points = scans[k].points
        points = points[voxel_downsample(points, spacing)]
        stream.log(f"{entity}/points", rerun.Points3D(points, radii=[0.03], colors=[(200, 200, 200)]))
