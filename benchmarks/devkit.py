"""Our nuScenes tracking metrics beside the official development kit's: largest difference, and times from files on.

The kit needs NumPy 1, so it lives in an environment of its own and is run by that one's python.
"""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from data_tools.datasets.nuscenes import NuScenes, read_scored_scenes, split_scenes, write_tracking_results
from data_tools.metrics import NuScenesClassMetrics, NuScenesTrackingMetrics, nuscenes_tracking_metrics
from data_tools.simulator import SimulatedTraffic, write_nuscenes
from pipelines.config import load_config
from pipelines.process import one_thread
from pipelines.tracking import track_dataset
from saga_fg.errors import InputError

PYTHON_VARIABLE = "SAGA_FG_DEVKIT_PYTHON"
VERSION = "v1.0-mini"  # of simulated scenes


@dataclass(frozen=True)
class OfficialFigures:
    """What the kit says: figures as it serialises them, and the CPU time it took, s."""

    figures: dict[str, Any]
    seconds: float


@dataclass(frozen=True)
class Parity:
    """Ours beside theirs.

    difference  the largest of any figure, overall or of a class (inf where only one of the two is defined), and `where`
    seconds     of CPU time: ours, theirs
    """

    amota: float
    difference: float
    where: str
    seconds: tuple[float, float]

    @property
    def ratio(self) -> float:
        """How many times faster ours are."""
        return self.seconds[1] / self.seconds[0]


def official_figures(python: str, result: Path, dataroot: Path, version: str, split: str) -> OfficialFigures:
    """Run the kit. Raises `InputError` with the end of what it said if it fails."""
    script = Path(__file__).with_name("devkit_figures.py")
    command = [python, str(script), *map(str, (result, dataroot, version, split))]
    try:
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"{python}: expected a python that has nuscenes-devkit: {error.strerror}") from error
    if run.returncode != 0:
        last = run.stderr.strip().splitlines()[-1:] or ["no word"]
        raise InputError(f"{python}: the development kit failed: {last[0]}")
    return OfficialFigures(**json.loads(run.stdout))


def tracked_simulation(dataroot: Path, scenes: int) -> Path:
    """Write simulated scenes to a folder, track them by method kf, and write the result beside; returns its path."""
    write_nuscenes(dataroot, SimulatedTraffic(scenes=scenes))
    dataset = NuScenes(dataroot, VERSION, {"lidar": dataroot / "detections" / "lidar.json"})
    runs = track_dataset(dataset, lambda: load_config("nuscenes").new_tracker("kf"))
    write_tracking_results(dataroot / "tracks.json", ((run.scene, run.tracks) for run in runs), dataset.meta)
    return dataroot / "tracks.json"


def parity(python: str, result: Path, dataroot: Path, version: str, split: str) -> Parity:
    """Score one result with both. Raises `InputError` for broken files or a kit that fails."""
    with one_thread():
        begin = time.process_time()
        scored = read_scored_scenes(result, dataroot, version, split_scenes(dataroot, version, split))
        ours = nuscenes_tracking_metrics([each.tracking for each in scored.values()])
        seconds = time.process_time() - begin
    theirs = official_figures(python, result, dataroot, version, split)
    where, difference = max(differences(ours, theirs.figures), key=lambda named: named[1])
    return Parity(ours.overall.amota, difference, where, (seconds, theirs.seconds))


def differences(ours: NuScenesTrackingMetrics, theirs: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Each figure by name, with the absolute difference.

    GT over all classes is left out: the official figure is a mean over classes, ours the sum.
    """
    for field in fields(NuScenesClassMetrics):
        if field.name != "gt":
            yield field.name, _apart(getattr(ours.overall, field.name), theirs[field.name])
        for label, value in theirs["label_metrics"][field.name].items():
            yield f"{field.name} of {label}", _apart(getattr(ours.per_class[label], field.name), value)


def _apart(a: float, b: float) -> float:
    if math.isnan(a) or math.isnan(b):
        return 0.0 if math.isnan(a) and math.isnan(b) else math.inf
    return abs(a - b)
