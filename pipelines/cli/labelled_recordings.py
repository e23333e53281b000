"""The recordings that a table of labels was made of, from the options that name them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.cli.options import sensor_files
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from pipelines.config import Family
    from saga_fg.types.dataset import Dataset


@dataclass(frozen=True, eq=False)
class LabelledRecordings:
    """A table of labels, the kind of its recordings, and these."""

    table: Path
    family: Family
    dataset: Dataset


def labelled_recordings(
    result: Path,
    nuscenes: Path | None,
    version: str,
    kitti: Path | None,
    file: Path | None,
    seed: int | None,
    simulator: Path | None,
    detections: Sequence[str],
    with_truth: bool,
) -> LabelledRecordings:
    """The recordings of the scenes in a table, or in the folder that holds it.

    Raises `InputError` unless exactly one kind of recordings is named, and for a result without a table.
    """
    import numpy as np

    from data_tools.datasets.label_table import read_label_table

    given = [value is not None for value in (nuscenes, kitti, file, seed)]
    if sum(given) != 1:
        raise InputError("expected exactly one of --nuscenes, --kitti, --file, --simulated")
    table = _table(result)
    scenes = tuple(np.unique(read_label_table(table).tracks.scene).tolist())
    if nuscenes is not None:
        from data_tools.datasets.nuscenes import NuScenes

        files = sensor_files(detections)
        return LabelledRecordings(table, "nuscenes", NuScenes(nuscenes, version, files, scenes, with_truth))
    if kitti is not None:
        from data_tools.datasets.kitti import KittiTracking

        if len(detections) != 1:
            raise InputError("--detections: expected the folder of a detector")
        return LabelledRecordings(table, "kitti", KittiTracking(kitti, Path(detections[0]), scenes, with_truth))
    if file is not None:
        from data_tools.datasets.detection_files import read_detections

        return LabelledRecordings(table, "file", read_detections(file))
    from data_tools.simulator import SimulatedTraffic, SimulatorSettings
    from pipelines.configuration import load_settings

    assert seed is not None
    traffic = load_settings(SimulatorSettings, simulator) if simulator is not None else SimulatorSettings()
    numbers = (re.fullmatch(r"scene-([0-9]{4,6})", name) for name in scenes)
    last = max((int(number[1]) for number in numbers if number), default=1)
    return LabelledRecordings(table, "simulated", SimulatedTraffic(traffic, max(last, 1), seed))


def _table(result: Path) -> Path:
    if not result.exists():
        raise InputError(f"{result}: expected a folder that `saga-fg smooth` wrote, or its table, there is nothing")
    if not result.is_dir():
        return result
    found = [result / f"labels{suffix}" for suffix in (".csv", ".ndjson") if (result / f"labels{suffix}").is_file()]
    if not found:
        raise InputError(f"{result}: expected labels.csv or labels.ndjson in this folder")
    return found[0]
