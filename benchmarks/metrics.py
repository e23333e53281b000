"""Our nuScenes tracking metrics beside the official development kit's.

The kit needs NumPy 1, so it lives in an environment of its own and is run by that one's python.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.runner import Rows
from data_tools.datasets.nuscenes import (
    NuScenes,
    read_scored_scenes,
    split_scenes,
    write_nuscenes,
    write_tracking_results,
)
from data_tools.metrics import NuScenesClassMetrics, NuScenesTrackingMetrics, nuscenes_tracking_metrics
from data_tools.simulator import SimulatedTraffic
from pipelines.config import load_config
from pipelines.tracking import one_thread, track_dataset
from saga_fg.errors import InputError, SagaError

PYTHON_VARIABLE = "SAGA_FG_DEVKIT_PYTHON"
VERSION = "v1.0-mini"  # of simulated scenes
TOLERANCE = 1e-6


def metrics(
    result: Annotated[
        Path | None, typer.Option("--result", help="Tracking-result JSON; without it, simulated scenes are tracked.")
    ] = None,
    dataroot: Annotated[Path | None, typer.Option("--dataroot", help="Folder that holds the folder of tables.")] = None,
    version: Annotated[str, typer.Option("--version", help="Name of the folder of tables.")] = VERSION,
    split: Annotated[str, typer.Option("--split", help="The split to score.")] = "all",
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Simulated scenes, if there is no result.")] = 2,
) -> Rows:
    """Our nuScenes tracking metrics beside the official development kit's: the same figures? how much faster?

    The kit needs NumPy 1: the variable SAGA_FG_DEVKIT_PYTHON names a python that has it (.ci/devkit-requirements.txt).
    Fails if a figure differs by more than 1e-6.

    \b
    Examples:
      export SAGA_FG_DEVKIT_PYTHON=devkit/bin/python
      python -m benchmarks metrics
      python -m benchmarks metrics --result tracks.json --dataroot data/nuscenes --split mini_train
    """
    python = os.environ.get(PYTHON_VARIABLE)
    if not python:
        raise InputError(f"{PYTHON_VARIABLE}: expected the name of a python that has nuscenes-devkit, it is not set")
    if (result is None) != (dataroot is None):
        raise InputError("expected both --result and --dataroot, or neither")
    with tempfile.TemporaryDirectory() as folder:
        if result is None or dataroot is None:
            dataroot = Path(folder) / "simulated"
            result = tracked_simulation(dataroot, scenes)
        row = parity(python, result, dataroot, version, split)
    yield "nuScenes tracking metrics, ours beside the official ones", row
    if row["largest difference"] > TOLERANCE:
        raise SagaError(f"the figures differ: {row['where']}")


def parity(python: str, result: Path, dataroot: Path, version: str, split: str) -> dict[str, Any]:
    """Score one result with both. Raises `InputError` for broken files or a kit that fails.

    The largest difference is that of any figure, overall or of a class: inf where only one of the two is defined.
    """
    with one_thread():
        begin = time.process_time()
        scored = read_scored_scenes(result, dataroot, version, split_scenes(dataroot, version, split))
        ours = nuscenes_tracking_metrics([each.tracking for each in scored.values()])
        seconds = time.process_time() - begin
    theirs, official = official_figures(python, result, dataroot, version, split)
    where, difference = max(differences(ours, theirs), key=lambda named: named[1])
    about = {"AMOTA": ours.overall.amota, "largest difference": difference, "where": where}
    return {**about, "CPU time, s": seconds, "official": official, "times faster": official / seconds}


def official_figures(
    python: str, result: Path, dataroot: Path, version: str, split: str
) -> tuple[dict[str, Any], float]:
    """The kit's figures as it serialises them, and its CPU time, s. Raises `InputError` with its last line if it fails.

    JSON with `figures` and `seconds` is what `devkit_figures.py` prints.
    """
    script = Path(__file__).with_name("devkit_figures.py")
    command = [python, str(script), *map(str, (result, dataroot, version, split))]
    try:
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"{python}: expected a python that has nuscenes-devkit: {error.strerror}") from error
    if run.returncode != 0:
        last = run.stderr.strip().splitlines()[-1:] or ["no word"]
        raise InputError(f"{python}: the development kit failed: {last[0]}")
    told = json.loads(run.stdout)
    return told["figures"], told["seconds"]


def tracked_simulation(dataroot: Path, scenes: int) -> Path:
    """Write simulated scenes to a folder, track them by method kf, and write the result beside; returns its path."""
    traffic = SimulatedTraffic(scenes=scenes)
    write_nuscenes(dataroot, traffic, traffic.mounts)
    dataset = NuScenes(dataroot, VERSION, {"lidar": dataroot / "detections" / "lidar.json"})
    runs = track_dataset(dataset, lambda: load_config("nuscenes").new_tracker("kf"))
    write_tracking_results(dataroot / "tracks.json", ((run.scene, run.tracks) for run in runs), dataset.meta)
    return dataroot / "tracks.json"


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
