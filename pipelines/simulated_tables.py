"""Simulated scenes of more than cars as tables, each with the settings that track it: those shipped, and its map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from data_tools.files.atomic_files import atomic_directory, write_text
from data_tools.simulator import SimulatedTraffic
from data_tools.simulator.table_export import write_tables
from pipelines.config import load_config
from pipelines.configuration import write_settings

_TABLES = tuple(f"scene-[0-9]*/{name}" for name in ("detections.csv", "truth.csv", "settings.yaml"))


def write_simulated_tables(directory: str | Path, dataset: SimulatedTraffic) -> None:
    """`SCENE/detections.csv`, `truth.csv` and `settings.yaml` for every scene; all appear when the last one is done.

    Raises `InputError` for a directory that is not writable.
    """
    shipped = load_config("heterogeneous")
    with atomic_directory(directory, known=_TABLES) as folder:
        for name in dataset.scenes:
            scene = dataset.scene(name)
            (folder / name).mkdir()
            write_tables(folder / name, scene)
            road_map = scene.frames[0].road_map if scene.frames else None
            settings = replace(shipped, tracker=replace(shipped.tracker, road_map=road_map))
            write_text(folder / name / "settings.yaml", write_settings(settings))
