"""Results on disk as scenes to view, with the scans of their LiDAR where there are any."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from data_tools.datasets.kitti import KittiScans
from data_tools.datasets.kitti.scored_sequences import read_scored_sequences
from data_tools.datasets.nuscenes import NuScenes, nuscenes_scans, read_scored_scenes
from pipelines.report.results import kitti_results, nuscenes_results, table_results
from pipelines.view.scenes import SceneView


def nuscenes_view(
    result: Path, dataroot: Path, version: str, scenes: Collection[str], detections: Mapping[str, Path], spacing: float
) -> list[SceneView]:
    """Read a tracking-result JSON; points are thinned to `spacing` m, 0 leaves them out.

    Raises `InputError` for missing or broken files, and for a result that lacks a sample of these scenes.
    """
    results = nuscenes_results(result, read_scored_scenes(result, dataroot, version, scenes, detections))
    scans = nuscenes_scans(NuScenes(dataroot, version, {}, scenes), dataroot) if spacing else {}
    return [SceneView(each, scans.get(each.scene.name), spacing) for each in results.scenes]


def kitti_view(
    result: Path, dataroot: Path, sequences: Collection[str] | None, detections: Path | None, spacing: float
) -> list[SceneView]:
    """Read a folder of results NNNN.txt; otherwise as above."""
    results = kitti_results(result, read_scored_sequences(result, dataroot, sequences, detections))
    root = dataroot / "training" if (dataroot / "training").is_dir() else dataroot
    views = []
    for each in results.scenes:
        name = each.scene.name
        seen = spacing > 0 and (root / "velodyne" / name).is_dir()
        views.append(SceneView(each, KittiScans(dataroot, name, timed=False) if seen else None, spacing))
    return views


def table_view(result: Path, detections: Path | None) -> list[SceneView]:
    """Read a table of tracks, with the table of their detections. Raises `InputError` for broken tables."""
    return [SceneView(each) for each in table_results(result, detections).scenes]
