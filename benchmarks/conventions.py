"""Tables in other conventions than ours: what is made of them by the command, by Python, and by the live service.

Each table is of one kind of traffic about a moving vehicle, drawn from a seed, and has at most one trap: positions of
the vehicle's or a camera's frame taken for the world, headings of a compass, mirrored or in degrees, times in
nanoseconds since the start, speeds in km/h, length and width exchanged. Tables without a trap show what is refused or
doubted for nothing.
"""

from __future__ import annotations

import logging
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

import saga_fg
from benchmarks.runner import Rows, Seed
from data_tools.datasets.detection_file_source import DetectionFileSource
from pipelines.checks import CheckedDataset, Checks
from pipelines.config import load_config
from saga_fg import InputError
from saga_fg.numerics import FloatArray
from saga_fg.tables import raw_table, scenes_of

RATE, SECONDS, REACH = 10.0, 12.0, 60.0  # Hz, s, m
NOISE, SPEED_NOISE, HEADING_NOISE, DETECTED = 0.15, 0.3, 0.05, 0.9  # m, m/s, rad, share
SIZES = {"car": (4.5, 1.9, 1.6), "pedestrian": (0.6, 0.6, 1.7), "bicycle": (1.8, 0.6, 1.7)}
CAMERA_HEIGHT = 1.6  # m
SPEEDS = "km/h"
NAMES = [*("timestamp", "label", "x", "y", "z", "length", "width", "height"), *("yaw", "vx", "vy", "score")]
NAMES += ["ego_x", "ego_y", "ego_yaw"]


@dataclass(frozen=True, eq=False)
class Traffic:
    """Paths in the world: of the vehicle (T, 2), of objects (N, T, 2), m, with their classes."""

    ego: FloatArray
    path: FloatArray
    label: tuple[str, ...]


def _along(start: FloatArray, heading: FloatArray, distance: FloatArray) -> FloatArray:
    """Straight paths (N, T, 2) from places (N, 2) and headings (N,), rad, by distances (N, T), m."""
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    return np.asarray(start[:, None] + distance[:, :, None] * ahead[:, None])


def _queue(time: FloatArray, rng: np.random.Generator) -> Traffic:
    own = np.cumsum(np.clip(5 + 4 * np.sin(time / 3 + rng.uniform(0, 6)), 0, None)) / RATE
    gaps = np.cumsum(rng.uniform(7, 11, 8))
    return Traffic(_along(np.zeros((1, 2)), np.zeros(1), own[None])[0], _lane(gaps, own, rng), ("car",) * 8)


def _lane(gaps: FloatArray, own: FloatArray, rng: np.random.Generator) -> FloatArray:
    later = np.array([np.interp(np.arange(len(own)) + 4 * k, np.arange(len(own)), own) for k in range(len(gaps))])
    start = np.column_stack([gaps, rng.normal(0, 0.2, len(gaps))])
    return _along(start, np.zeros(len(gaps)), later - later[:, :1] * 0.5)


def _crossing(time: FloatArray, rng: np.random.Generator) -> Traffic:
    own = np.cumsum(np.clip(8 - 0.6 * time, 2, None)) / RATE
    heading = np.repeat([0.0, np.pi / 2, np.pi, -np.pi / 2], 4)
    back = rng.uniform(-45, 10, 16)
    side = np.array([-1.75])
    start = _along(
        np.array([40.0, 0.0]) + side * np.column_stack([-np.sin(heading), np.cos(heading)]), heading, back[:, None]
    )[:, 0]
    moved = rng.uniform(3, 11, (16, 1)) * time
    return Traffic(_along(np.zeros((1, 2)), np.zeros(1), own[None])[0], _along(start, heading, moved), ("car",) * 16)


def _parked(time: FloatArray, rng: np.random.Generator) -> Traffic:
    own = 7 * time
    parked = np.column_stack([np.arange(0, 120, 7) + rng.uniform(-1, 1, 18), np.where(np.arange(18) % 2, 4.5, -3.0)])
    moving = np.column_stack([rng.uniform(20, 110, 3), np.full(3, 2.0)])
    heading = np.concatenate([np.zeros(18), np.full(3, np.pi)])
    moved = np.concatenate([np.zeros((18, len(time))), rng.uniform(5, 9, (3, 1)) * time])
    paths = _along(np.concatenate([parked, moving]), heading, moved)
    return Traffic(_along(np.zeros((1, 2)), np.zeros(1), own[None])[0], paths, ("car",) * 21)


def _crowd(time: FloatArray, rng: np.random.Generator) -> Traffic:
    start, heading = rng.uniform([5, 3], [40, 25], (34, 2)), rng.uniform(-np.pi, np.pi, 34)
    start[::2, 1] *= -1
    heading = np.where(np.sign(np.sin(heading)) == np.sign(start[:, 1]), heading, -heading)  # away from the vehicle
    speed = np.concatenate([rng.uniform(0.9, 1.7, 30), rng.uniform(3, 6, 4)])
    own = 1.5 * time
    label = ("pedestrian",) * 30 + ("bicycle",) * 4
    return Traffic(
        _along(np.zeros((1, 2)), np.zeros(1), own[None])[0], _along(start, heading, speed[:, None] * time), label
    )


def _motorway(time: FloatArray, rng: np.random.Generator) -> Traffic:
    speed = 30 + rng.normal(0, 3, 12)
    start = np.column_stack([np.linspace(-50, 60, 12), 3.5 * rng.choice([-1, 1], 12)])
    own = np.column_stack([30 * time, np.full(len(time), 0.5)])
    return Traffic(own, _along(start, np.zeros(12), speed[:, None] * time), ("car",) * 12)


KINDS: Mapping[str, Callable[[FloatArray, np.random.Generator], Traffic]] = {
    "queue": _queue,
    "crossing": _crossing,
    "parked street": _parked,
    "crowd": _crowd,
    "motorway": _motorway,
}


def table(kind: str, rng: np.random.Generator, speeds: bool) -> pd.DataFrame:
    """Detections of a kind of traffic in the world, in our conventions, with the vehicle's pose."""
    time = np.arange(0, SECONDS, 1 / RATE)
    traffic = KINDS[kind](time, rng)
    turn, shift = rng.uniform(-np.pi, np.pi), rng.choice([0.0, 1000.0]) * rng.normal(size=2)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    ego, path = traffic.ego @ R.T + shift, traffic.path @ R.T + shift
    velocity = np.gradient(path, 1 / RATE, axis=1)
    ego_yaw = np.full(len(time), turn)
    slow = np.hypot(*np.moveaxis(velocity, 2, 0)) < 0.05
    yaw = np.where(slow, turn, np.arctan2(velocity[..., 1], velocity[..., 0]))
    rows = []
    for t, moment in enumerate(time.tolist()):
        near = np.flatnonzero(np.hypot(*(path[:, t] - ego[t]).T) < REACH)
        for n in near[rng.random(len(near)) < DETECTED].tolist():
            x, y = path[n, t] + rng.normal(0, NOISE, 2)
            vx, vy = velocity[n, t] + rng.normal(0, SPEED_NOISE, 2)
            size = np.array(SIZES[traffic.label[n]]) * rng.normal(1, 0.03, 3)
            heading = yaw[n, t] + rng.normal(0, HEADING_NOISE)
            measured = (vx, vy) if speeds else (np.nan, np.nan)
            pose = (*ego[t], ego_yaw[t])
            row = (moment, traffic.label[n], x, y, 0.8, *size, heading, *measured, rng.uniform(0.4, 1.0), *pose)
            rows.append(row)
    made = pd.DataFrame(rows, columns=NAMES)
    made["yaw"] = np.arctan2(np.sin(made["yaw"]), np.cos(made["yaw"]))
    return made if speeds else made.drop(columns=["vx", "vy"])


def _of_ego(made: pd.DataFrame) -> pd.DataFrame:
    c, s = np.cos(made["ego_yaw"]), np.sin(made["ego_yaw"])
    dx, dy = made["x"] - made["ego_x"], made["y"] - made["ego_y"]
    found = made.assign(x=c * dx + s * dy, y=-s * dx + c * dy, yaw=_wrapped(made["yaw"] - made["ego_yaw"]))
    return found if "vx" not in made else found.assign(vx=c * made.vx + s * made.vy, vy=-s * made.vx + c * made.vy)


def _of_camera(made: pd.DataFrame) -> pd.DataFrame:
    ego = _of_ego(made)
    ego = ego[ego["x"] > 1.0]
    found = ego.assign(x=-ego["y"], y=CAMERA_HEIGHT - ego["z"], z=ego["x"], yaw=_wrapped(-ego["yaw"] - np.pi / 2))
    return found if "vx" not in made else found.drop(columns=["vx", "vy"])


def _wrapped(angle: pd.Series) -> pd.Series:
    return np.arctan2(np.sin(angle), np.cos(angle))


TRAPS: Mapping[str, Callable[[pd.DataFrame], pd.DataFrame]] = {
    "vehicle's frame as world": _of_ego,
    "camera axes": _of_camera,
    "compass": lambda made: made.assign(yaw=np.degrees(np.pi / 2 - made["yaw"]) % 360),
    "mirrored headings": lambda made: made.assign(yaw=-made["yaw"]),
    "headings in degrees": lambda made: made.assign(yaw=np.degrees(made["yaw"])),
    "elapsed ns": lambda made: made.assign(timestamp=(made["timestamp"] * 1e9).round().astype(np.int64)),
    SPEEDS: lambda made: made.assign(vx=3.6 * made["vx"], vy=3.6 * made["vy"]),
    "sizes exchanged": lambda made: made.assign(length=made["width"], width=made["length"]),
}


def conventions(
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Tables of each kind of traffic and trap.")] = 1,
    seed: Seed = 0,
) -> Rows:
    """Tables in other conventions: taken as they are meant, stopped by name, doubted, or silently wrong?

    \b
    Examples:
      python -m benchmarks conventions
      python -m benchmarks conventions --seeds 5 --seed 7
    """
    for trap, change in {"none": lambda made: made, **TRAPS}.items():
        counts = {f"{door}, {what}": 0 for door in DOORS for what in OUTCOMES}
        for number in range(seeds * (1 if trap != "none" else len(TRAPS))):
            for kind in KINDS:
                rng = np.random.default_rng([seed, number, *map(ord, kind + trap)])
                made = change(table(kind, rng, trap == SPEEDS or number % 2 == 0))
                for door, read in DOORS.items():
                    counts[f"{door}, {_outcome(read, made)}"] += 1
        yield "Tables", {"trap": trap, **{name: count for name, count in counts.items() if name not in NEVER}}


def _outcome(read: Callable[[pd.DataFrame], list[str]], made: pd.DataFrame) -> str:
    try:
        told = [text for text in read(made) if "no edges" not in text]  # of a crowd, by the settings of Python
    except InputError:
        return "stopped"
    return "warned" if told else "silent"


class _Heard(logging.Handler):
    """Keeps warnings."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.told: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one."""
        self.told.append(record.getMessage())


def _command(made: pd.DataFrame) -> list[str]:
    with tempfile.TemporaryDirectory() as folder, _heard() as told:
        path = Path(folder) / "table.csv"
        made.to_csv(path, index=False)
        source, settings = DetectionFileSource(detections=[str(path)]), load_config("file")
        with source.open() as dataset:
            checked = CheckedDataset(dataset, Checks(settings, settings))
            for name in checked.scenes:
                checked.scene(name)
    return told


def _python(made: pd.DataFrame) -> list[str]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        saga_fg.track(made)
    return [str(each.message) for each in told]


def _service(made: pd.DataFrame) -> list[str]:
    raw, settings = raw_table(made), load_config("file")
    yaw, checks = raw.numbers("yaw"), Checks(settings)
    tracker, done = saga_fg.Tracker(settings.of_method("saga").tracker), 0
    with _heard() as told:
        for scene in scenes_of(raw):
            for frame in scene.frames:
                checks.watch(frame, yaw[done : done + len(frame)], tracker.step(frame))
                done += len(frame)
    return [text for text in told if "out of bounds" not in text]


@contextmanager
def _heard() -> Iterator[list[str]]:
    """What is warned of."""
    handler, log = _Heard(), logging.getLogger()
    log.addHandler(handler)
    try:
        yield handler.told
    finally:
        log.removeHandler(handler)


OUTCOMES = ("stopped", "warned", "silent")
DOORS: Mapping[str, Callable[[pd.DataFrame], list[str]]] = {
    "command": _command,
    "Python": _python,
    "service": _service,
}
NEVER = ("service, stopped",)
