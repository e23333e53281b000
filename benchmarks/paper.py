"""The paper's table on given recordings: what each sensor, and both together, give to each method.

Reference: Sani and Anand, Graph-Based Multi-Modal Sensor Fusion for Autonomous Driving, arXiv 2411.03702, table 1: the
150 scenes of the nuScenes validation set, with the authors' own detections.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from data_tools.figures import FigureTable, cell, count
from pipelines.bench.recordings import NuScenesSet
from pipelines.bench.variants import METHODS
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, track_scene

FUSION = "fusion"
NAMES: dict[Method, str] = {"centerpoint": "CenterPoint", "kf": "classical KF", "saga": "SAGA"}


@dataclass(frozen=True)
class PaperFigures:
    """AMOTA, AMOTP in m, identity switches."""

    amota: float
    amotp: float
    ids: float


PUBLISHED: Mapping[str, Mapping[Method, PaperFigures]] = {
    "camera": {
        "centerpoint": PaperFigures(0.3684, 1.0101, 870),
        "kf": PaperFigures(0.3357, 1.0374, 398),
        "saga": PaperFigures(0.3357, 1.0375, 399),
    },
    "lidar": {
        "centerpoint": PaperFigures(0.5305, 0.7062, 2521),
        "kf": PaperFigures(0.5377, 0.7422, 1363),
        "saga": PaperFigures(0.5382, 0.7418, 1392),
    },
    FUSION: {
        "centerpoint": PaperFigures(0.3499, 0.7626, 2099),
        "kf": PaperFigures(0.3971, 0.6969, 960),
        "saga": PaperFigures(0.3976, 0.6950, 946),
    },
}


def paper_table(
    dataroot: Path, split: str, camera: Path, lidar: Path, base: TrackConfig, progress: Progress | None = None
) -> dict[str, dict[Method, PaperFigures]]:
    """Figures by sensors and method on the scenes of a split. Raises `InputError` for missing or broken files."""
    files = {"camera": camera, "lidar": lidar}
    result: dict[str, dict[Method, PaperFigures]] = {}
    for sensors, detections in (*((name, {name: file}) for name, file in files.items()), (FUSION, files)):
        recordings = NuScenesSet(sensors, dataroot, detections, split)
        result[sensors] = {}
        for variant in METHODS:
            runs = {
                name: track_scene(recordings.dataset.scene(name), base.new_tracker(variant.method), progress)
                for name in recordings.dataset.scenes
            }
            f = recordings.score(runs).figures
            result[sensors][variant.method] = PaperFigures(f["AMOTA"], f["AMOTP"], f["IDS"])
    return result


def shown(measured: Mapping[str, Mapping[Method, PaperFigures]], split: str) -> FigureTable:
    """Ours beside the published ones."""
    rows = []
    for sensors, by_method in measured.items():
        for method, name in NAMES.items():
            both = (by_method[method], PUBLISHED[sensors][method])
            rows.append((f"{sensors}, {name}", *(text for figures in both for text in _cells(figures))))
    columns = ("sensors, method", "AMOTA, %", "AMOTP, m", "IDS", "paper: AMOTA, %", "AMOTP, m", "IDS")
    title = f"{split}, beside the paper's figures (the 150 scenes of the validation set, other detections)"
    return FigureTable(title, columns, tuple(rows))


def _cells(f: PaperFigures) -> tuple[str, str, str]:
    return cell(100 * f.amota, 2), cell(f.amotp, 4), count(f.ids)
