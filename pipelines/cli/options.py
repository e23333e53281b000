"""Options that several commands share, and the parsing of their values."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.cli.reporting import set_up_logging
from saga_fg.errors import InputError

Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Say more on stderr.", callback=set_up_logging, show_default=False)
]
Scenario = Literal["traffic", "red-light", "road-works", "towing", "cycling"]

Config = Annotated[
    Path | None, typer.Option("--config", help="YAML file over the defaults; see `saga-fg config`.", metavar="FILE")
]

Online = Annotated[
    bool, typer.Option("--online", help="Estimate online too, with a fixed-lag smoother, beside the full batch.")
]
Lag = Annotated[float | None, typer.Option("--lag", min=0.0, help="Length of the window of --online, s.  [default: 3]")]

# of every command that reads nuScenes
TrackingResult = Annotated[Path, typer.Argument(help="Tracking-result JSON, of any tracker.")]
Tables = Annotated[Path, typer.Option("--dataroot", help="Folder that holds the folder of tables.")]
Version = Annotated[str, typer.Option("--version", help="Name of the folder of tables.")]
Split = Annotated[
    str | None, typer.Option("--split", help="An official split, or one of splits.json beside the tables.")
]
SceneNames = Annotated[str | None, typer.Option("--scenes", help="Scene names with commas between them.")]
SensorDetections = Annotated[
    list[str], typer.Option("--detections", help="Detection-result JSON of a sensor; repeatable.", metavar="NAME=FILE")
]

# of those that read KITTI sequences, simulated traffic, a table
KittiRoot = Annotated[
    str, typer.Option("--dataroot", help="Folder that holds training/, or oxts/ and calib/; or its URL.")
]
KittiDetections = Annotated[
    str, typer.Option("--detections", help="Folder with Car/, Pedestrian/, Cyclist/, in each NNNN.txt; or its URL.")
]
Sequences = Annotated[
    str | None, typer.Option("--sequences", help="Sequences with commas between them; all if left out.")
]
Simulator = Annotated[
    Path | None, typer.Option("--simulator", help="YAML file; see `saga-fg config --simulator`.", metavar="FILE")
]
ScenesOfFile = Annotated[
    str | None, typer.Option("--scenes", help="Scene names with commas between them; all if left out.")
]

# of those that look at results, beside what these were made of
ResultSequences = Annotated[
    str | None, typer.Option("--sequences", help="Sequences with commas between them; all results if left out.")
]
SeenBySensors = Annotated[
    list[str] | None,
    typer.Option("--detections", help="Detections the tracks were made of, to see them too.", metavar="NAME=FILE"),
]
SeenFolder = Annotated[
    Path | None, typer.Option("--detections", help="Folder of the detections the tracks were made of.")
]
SeenTable = Annotated[
    Path | None, typer.Option("--detections", help="Table of the detections the tracks were made of.")
]


def sensor_files(values: Sequence[str]) -> dict[str, Path]:
    """`["lidar=a.json", "camera=b.json"]` as a mapping; a lone file without a name is the sensor "lidar"."""
    return {sensor: Path(path) for sensor, path in sensor_locations(values).items()}


def sensor_locations(values: Sequence[str]) -> dict[str, str]:
    """The same where files may be given by URL."""
    files: dict[str, str] = {}
    for value in values:
        sensor, equals, path = value.partition("=")
        if "://" in sensor:  # a URL without a name before it
            sensor, equals, path = value, "", ""
        if not equals and len(values) == 1:
            sensor, path = "lidar", value
        if not sensor or not path:
            raise InputError(f"--detections {value}: expected NAME=FILE, e.g. lidar={value or 'detections.json'}")
        if sensor in files:
            raise InputError(f"--detections {value}: the sensor {sensor} is given twice")
        files[sensor] = path
    return files


def online_window(online: bool, lag: float | None) -> float | None:
    """Length of the window, s, None without --online. Raises `InputError` where --lag would have no effect."""
    if lag is not None and not online:
        raise InputError(f"--lag {lag:g}: expected with --online only")
    return (3.0 if lag is None else lag) if online else None


def chosen_scenes(dataroot: Path, version: str, split: str | None, scenes: str | None) -> tuple[str, ...]:
    """The nuScenes scenes that --split or --scenes, of which one must be given, stand for."""
    from data_tools.datasets.nuscenes import split_scenes

    if (split is None) == (scenes is None):
        raise InputError("expected either --split NAME or --scenes A,B")
    return split_scenes(dataroot, version, split) if split is not None else names("--scenes", scenes or "")


def apart(output: Path, *inputs: Path, option: str = "--output") -> None:
    """Raise `InputError` where the output, which `option` names, would overwrite what is read."""
    for path in inputs:
        if os.path.realpath(output) == os.path.realpath(path):  # unlike Path.resolve, it stands links in a circle
            raise InputError(f"{option} {output}: expected another file than those that are read")


def names(option: str, value: str) -> tuple[str, ...]:
    """The entries of a comma-separated option, each once."""
    entries = tuple(dict.fromkeys(entry.strip() for entry in value.split(",") if entry.strip()))
    if not entries:
        raise InputError(f"{option}: expected names with commas between them, got {value!r}")
    return entries


def counts(option: str, value: str, least: int = 1) -> tuple[int, ...]:
    """The entries of a comma-separated option as whole numbers from `least` on, each once."""
    entries = names(option, value)
    if not all(entry.isdecimal() and len(entry) < 10 and int(entry) >= least for entry in entries):
        raise InputError(f"{option}: expected whole numbers >= {least} with commas between them, got {value[:40]!r}")
    return tuple(map(int, entries))
