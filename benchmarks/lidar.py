"""LiDAR geometry on real scans: what each function finds and costs, and how good boxes without a detector are.

Recall is the share of labelled cars (vans are cars here) within reach that have a box of that class within 2 m, one to
one; precision the share of those boxes that lie on a labelled car. KITTI's labels cover the camera's image alone:
boxes whose centre is outside it, or in a region marked `DontCare`, are left out. The boxes are then tracked by the
graph tracker, and its tracks measured the same way.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_tools.datasets.kitti import KittiObjects, KittiScans, KittiTracking, read_kitti_labels
from data_tools.lidar import (
    Ground,
    Plane,
    detect_clusters,
    extract_curbs,
    extract_poles,
    extract_walls,
    fit_ground,
    segment_ground,
    voxel_downsample,
)
from pipelines.config import load_config
from pipelines.detector_free import cluster_scene
from pipelines.process import one_thread
from pipelines.tracking import Progress, track_scene
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.types.boxes import Boxes

CARS = ("car", "van")
MATCHED = 2.0  # m


@dataclass(frozen=True)
class GeometryRow:
    """One function over all scans: mean number of what it found, and milliseconds of CPU time, medians of a scan."""

    name: str
    found: float
    milliseconds: float


@dataclass(frozen=True)
class BoxScores:
    """labels: labelled cars within reach; matched: of them with a box; boxes: in the image and within reach; error:
    median distance of the centres of matched pairs, m; identities: tracks among the matched ones, 0 for detections.
    """

    labels: int
    matched: int
    boxes: int
    error: float
    identities: int

    @property
    def recall(self) -> float:
        return self.matched / self.labels if self.labels else float("nan")

    @property
    def precision(self) -> float:
        return self.matched / self.boxes if self.boxes else float("nan")


@dataclass(frozen=True)
class LidarBench:
    """geometry of all scans; boxes of clusters and of their tracks; objects: labelled cars, each counted once."""

    geometry: tuple[GeometryRow, ...]
    clusters: BoxScores
    tracks: BoxScores
    objects: int


def bench_lidar(
    dataroot: Path, sequence: str, reach: float = 30.0, most: int | None = None, progress: Progress | None = None
) -> LidarBench:
    """All figures of a KITTI sequence; `reach` in m from the vehicle."""
    scans = KittiScans(dataroot, sequence, most=most)
    truth = _Labels(dataroot, sequence, scans, reach)
    with one_thread():
        geometry = _geometry(scans, progress)
        scene = cluster_scene("clusters", scans, progress=progress)
        run = track_scene(scene, load_config("file").new_tracker("saga"), progress)
    return LidarBench(
        geometry,
        truth.scores([frame.detections.boxes for frame in scene.frames]),
        truth.scores([tracks.boxes for tracks in run.tracks], [tracks.id.tolist() for tracks in run.tracks]),
        truth.objects,
    )


def _geometry(scans: KittiScans, progress: Progress | None) -> tuple[GeometryRow, ...]:
    found: dict[str, list[tuple[float, float]]] = {}

    def measured(name: str, call: Callable[[], Any], count: Callable[[Any], float] = len) -> Any:
        begin = time.process_time()
        result = call()
        found.setdefault(name, []).append((count(result), 1e3 * (time.process_time() - begin)))
        return result

    for k in range(len(scans)):
        points = measured("read (points)", partial(scans.__getitem__, k)).points
        measured("thin to 0.5 m (points)", partial(voxel_downsample, points, 0.5))
        ground = measured("ground (points)", partial(segment_ground, points), _ground_points)
        measured("ground plane", partial(fit_ground, points[ground.is_ground]), _planes)
        walls = measured("walls", partial(extract_walls, points[~ground.is_ground]))
        measured("poles", partial(extract_poles, points, ground.height, walls))
        measured("curbs (points)", partial(extract_curbs, points, ground.height))
        measured("objects", partial(detect_clusters, points))
        if progress is not None:
            progress("geometry", k + 1, len(scans))
    rows = ((name, np.array(values)) for name, values in found.items())
    return tuple(GeometryRow(name, float(v[:, 0].mean()), float(np.median(v[:, 1]))) for name, v in rows)


def _ground_points(ground: Ground) -> float:
    return float(ground.is_ground.sum())


def _planes(plane: Plane | None) -> float:
    return float(plane is not None)


class _Labels:
    """The labelled cars of a sequence at its scans, and where in the image labels may be."""

    def __init__(self, dataroot: Path, sequence: str, scans: KittiScans, reach: float) -> None:
        dataset = KittiTracking(dataroot, sequences=[sequence], ground_truth=True)
        scene = dataset.scene(sequence)
        calibration = dataset.calibration(sequence)
        assert scene.ground_truth is not None
        root = Path(dataroot)
        labels = (root / "training" if (root / "training").is_dir() else root) / "label_02" / f"{sequence}.txt"
        marked = read_kitti_labels(labels)
        self._ignored: KittiObjects = marked.select(marked.type == "DontCare")
        self._image = marked.bbox[:, 2:].max(axis=0)  # the labels reach to the borders of the image
        self._projection, self._camera_T_imu = calibration.projection, calibration.camera_T_imu
        self._frames, self._poses, self._reach = scans.frames, scans.world_T_ego, reach
        self._cars: list[FloatArray] = []
        seen: set[str] = set()
        for k, frame in enumerate(scans.frames.tolist()):
            moment = scene.ground_truth[frame]
            rows = np.isin(moment.boxes.label, CARS) & self._near(moment.boxes, k)
            self._cars.append(moment.boxes.position[rows, :2])
            seen |= set(moment.id[rows].tolist())
        self.objects = len(seen)

    def scores(self, found: list[Boxes], ids: list[list[int]] | None = None) -> BoxScores:
        """Of boxes in world coordinates, one table a scan."""
        labels = boxes = 0
        errors: list[float] = []
        identities: set[int] = set()
        for k, (cars, table) in enumerate(zip(self._cars, found, strict=True)):
            rows = np.flatnonzero((table.label == "car") & self._near(table, k) & self._labelled(table, k))
            distance = np.linalg.norm(cars[:, None] - table.position[rows, :2], axis=2)
            i, j = linear_sum_assignment(np.where(distance <= MATCHED, distance - 1e3, 0.0))
            pairs = [(a, b) for a, b in zip(i.tolist(), j.tolist(), strict=True) if distance[a, b] <= MATCHED]
            errors += [float(distance[a, b]) for a, b in pairs]
            identities |= {ids[k][int(rows[b])] for _, b in pairs} if ids is not None else set()
            labels, boxes = labels + len(cars), boxes + len(rows)
        median = float(np.median(errors)) if errors else float("nan")
        return BoxScores(labels, len(errors), boxes, median, len(identities))

    def _near(self, boxes: Boxes, k: int) -> BoolArray:
        return np.asarray(np.linalg.norm(boxes.position[:, :2] - self._poses[k, :2, 3], axis=1) <= self._reach)

    def _labelled(self, boxes: Boxes, k: int) -> BoolArray:
        """Which centres lie in the image, outside the regions without labels."""
        camera = transform_points(self._camera_T_imu @ inverse_transform(self._poses[k]), boxes.position)
        image = camera @ self._projection[:, :3].T + self._projection[:, 3]
        pixel = image[:, :2] / np.maximum(image[:, 2:], 1e-6)
        inside = (camera[:, 2] > 0) & ((pixel >= 0) & (pixel <= self._image)).all(axis=1)
        for left, top, right, bottom in self._ignored.bbox[self._ignored.frame == self._frames[k]].tolist():
            within = (pixel[:, 0] >= left) & (pixel[:, 0] <= right) & (pixel[:, 1] >= top) & (pixel[:, 1] <= bottom)
            inside &= ~within
        return np.asarray(inside)
