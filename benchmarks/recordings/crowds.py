"""Crowds: pedestrians who cross each other's way, simulated, and those recorded by ETH.

Simulated ones walk in three streams, `WIDTH` m wide, that meet in the middle. A pedestrian keeps to a course of its
own at its own speed, and gives way to others by social forces (Helbing and Molnar, Physical Review E 51, 1995),
so that two pass each other at 0.3 to 1 m. A sensor sees them from a mast `RATE` times a second, some behind others.

Walking pedestrians of ETH and UCY: files of annotated places, in; `Scene`s with ground truth alone, out.

    frame  person  x  z  y  vx  vz  vy                       `eth/obsmat.txt`, `hotel/obsmat.txt`: m and m/s, z = 0
    frame  person  x  y                                      `NAME.txt`, such as `zara01.txt`, `students03.txt`

A row is a person at an annotated moment, every 0.4 s. Frames count those of the video: `eth` has 15 a second and
`hotel` 25, as the velocity columns imply; elsewhere the usual step between annotated frames is 0.4 s. Velocities that
are not there are central differences. The scenes have no vehicle (poses are the identity), no frames of detections and
no sizes; the yaw is the course of the velocity.

Sources: Pellegrini, Ess, Schindler, van Gool, You'll Never Walk Alone, ICCV 2009; Lerner, Chrysanthou, Lischinski,
Crowds by Example, Eurographics 2007; files as OpenTraj (https://github.com/crowdbotp/OpenTraj) and Social GAN
(https://github.com/agrimgupta92/sgan) distribute them.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings, on_grid
from data_tools.datasets.detection_files import read_detections
from data_tools.datasets.given_tracks import DetectedScenes
from data_tools.datasets.source import ChosenScenes, DatasetSource, option
from data_tools.files import local_copy, local_tree, read_table
from data_tools.trajectories import central_differences
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import FloatArray, IntArray, StrArray
from saga_fg.types import Annotations, Boxes, Dataset, Scene

FRAME_RATES = {"eth": 15.0, "hotel": 25.0}  # of the videos, 1/s
_COLUMNS = ("frame", "person", "x", "z", "y", "vx", "vz", "vy")
_PLACES = ("frame", "person", "x", "y")
_INTERVAL = 0.4  # s between annotations
_LONGEST_GAP = 0.9  # s between annotations of a person, for a velocity


class EthUcy:
    """The recordings below `root`: eth/obsmat.txt, hotel/obsmat.txt and NAME.txt; or the one of a file.

    Files are read when asked for. Raises `InputError` for a root without any.
    """

    def __init__(self, root: str | Path) -> None:
        self._root = Path(root)
        known = {name: self._root / name / "obsmat.txt" for name in FRAME_RATES}
        if self._root.is_file():
            name = self._root.parent.name if self._root.name == "obsmat.txt" else self._root.stem
            self._files = {name: self._root}
        else:
            there = {path.stem: path for path in sorted(self._root.glob("*.txt"))}
            self._files = {name: path for name, path in known.items() if path.is_file()} | there
        if not self._files:
            raise InputError(f"{self._root}: expected eth/obsmat.txt or hotel/obsmat.txt, or NAME.txt, there is none")

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the recordings."""
        return tuple(self._files)

    def scene(self, name: str) -> Scene:
        """Read a recording; raises `InputError` for an unknown name or a line that is not as above."""
        if name not in self._files:
            raise InputError(f"{self._root}: {unknown_name('recording', name, self.scenes)}")
        path = self._files[name]
        table = read_table(path, (len(_COLUMNS), len(_PLACES)), f"{' '.join(_COLUMNS)}, or {' '.join(_PLACES)}")
        n = len(table)
        if not n:
            raise InputError(f"{path}: expected rows, there are none")
        frame, person = table.integers(0, "frame", 0), table.integers(1, "person", 0)
        seconds = frame / _frame_rate(name, frame)
        if table.values.shape[1] == len(_COLUMNS):
            place = table.numbers([2, 4], ("x", "y"))
            velocity = table.numbers([5, 7], ("vx", "vy"))
        else:
            place = table.numbers([2, 3], ("x", "y"))
            velocity = central_differences(person.astype(np.str_), seconds, place, _LONGEST_GAP)
        boxes = Boxes(
            np.full(n, "pedestrian"),
            np.column_stack([place, np.zeros(n)]),
            np.full((n, 3), np.nan),
            np.arctan2(velocity[:, 1], velocity[:, 0]),
            velocity,
        )
        order = np.argsort(frame, kind="stable")
        frames, first = np.unique(frame[order], return_index=True)
        truth = []
        for number, rows in zip(frames.tolist(), np.split(order, first[1:]), strict=True):
            with error_context(f"{path}: frame {number}"):
                truth.append(Annotations(person[rows].astype(np.str_), boxes.select(rows)))
        tokens = tuple(map(str, frames.tolist()))
        return Scene(name, frames / _frame_rate(name, frame), tokens=tokens, ground_truth=truth)


def _frame_rate(name: str, frame: IntArray) -> float:
    """Frames of the video in a second."""
    step = np.diff(np.unique(frame))
    return FRAME_RATES.get(name, float(np.median(step)) / _INTERVAL if len(step) else 1.0)


@dataclass(frozen=True, kw_only=True)
class EthUcySource(DatasetSource):
    """Walking pedestrians of ETH and UCY, annotated every 0.4 s.

    Without a table, detections are the boxes without identities and velocities.
    """

    name = "benchmarks.recordings:EthUcySource"
    example = "--dataroot data/eth_ucy --scenes hotel"
    dataroot: str = option("Folder that holds eth/ and hotel/ or files NAME.txt, or its URL; or one such file.")

    detections: str | None = option(
        "Table of detections (.csv, .ndjson, .jsonl, .npz), s from the recording's first moment; without it, what is "
        "annotated and visible is detected, without identities and velocities.",
        None,
        metavar="TABLE",
    )
    scenes: str | None = option("Recordings with commas between them; all if left out.", None)

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        with local_tree(self.dataroot, ["*/obsmat.txt", "*.txt"]) as root:
            recordings: Dataset = EthUcy(root)
            dataset = recordings if self.scenes is None else ChosenScenes(recordings, self.scenes)
            if self.detections is None:
                yield DetectedScenes(dataset, None)
            else:
                with local_copy(self.detections) as path:
                    yield DetectedScenes(dataset, read_detections(path))


RATE = 2.5  # frames a second, as the recorded ones are annotated
DURATION, STEP = 40.0, 0.02  # s; of the integration
WIDTH, REACH = 3.0, 9.0  # m, of a stream; half of its length
COURSES = np.radians([0.0, 155.0, 260.0])  # of the streams, no end of which is near another
FLOW = 0.5  # pedestrians a second and stream
SPEED, SPEED_DEVIATION = 1.34, 0.26  # m/s
RELAXATION = 0.5  # s, in which a pedestrian comes back to its velocity
FORCE, FORCE_RANGE = 16.0, 0.17  # m/s^2 at no distance; m, over which it falls by e
SWAY = 0.25  # m/s^1.5, of the acceleration that nobody explains
SIZE = (0.6, 0.6)  # m
WINDOW = 60.0  # s of a recorded scene
GAP = 0.9  # s between annotations, across which a recorded place is interpolated


def simulated_crowds(scenes: int, seed: int = 0) -> Recordings:
    """Recordings of crossing streams."""
    names = tuple(f"crowd-{k}" for k in range(scenes))
    return Recordings(names, lambda name: _walked(name, np.random.default_rng([seed, zlib.crc32(name.encode())])))


def _walked(name: str, rng: np.random.Generator) -> RecordedTraffic:
    steps, every = round((DURATION + 2 * REACH / SPEED) / STEP), round(PERIOD / STEP)
    first = round(2 * REACH / SPEED / PERIOD)
    x, v, wish, number = np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.int64)
    rows, courses = [], np.column_stack([np.cos(COURSES), np.sin(COURSES)])
    total = 0
    for k in range(steps + 1):
        for course in courses[rng.random(len(courses)) < FLOW * STEP]:
            aside = np.array([-course[1], course[0]]) * rng.uniform(-WIDTH / 2, WIDTH / 2)
            turn, speed = rng.normal(0, 0.1), max(rng.normal(SPEED, SPEED_DEVIATION), 0.6)
            ahead = speed * (course + turn * np.array([-course[1], course[0]]))
            x, v = np.concatenate([x, [aside - REACH * course]]), np.concatenate([v, [ahead]])
            wish, number, total = np.concatenate([wish, [ahead]]), np.append(number, total), total + 1
        apart = x[:, None] - x
        distance = np.hypot(*np.moveaxis(apart, 2, 0)) + 1e-9
        np.fill_diagonal(distance, np.inf)
        away = (FORCE * np.exp(-distance / FORCE_RANGE) / distance)[:, :, None] * apart
        noise = SWAY * rng.normal(size=x.shape) / np.sqrt(STEP)
        v = v + STEP * ((wish - v) / RELAXATION + away.sum(axis=1) + noise)
        x = x + STEP * v
        here = (x * wish).sum(axis=1) <= REACH * np.hypot(*wish.T)
        x, v, wish, number = x[here], v[here], wish[here], number[here]
        if k % every == 0 and k // every >= first:
            rows.append((np.full(len(x), k // every - first), number, x, v))
    moment, who, place, velocity = (np.concatenate(column) for column in zip(*rows, strict=True))
    return _pedestrians(name, moment, who.astype(np.str_), place, velocity)


def _pedestrians(
    name: str, moment: IntArray, who: StrArray, place: FloatArray, velocity: FloatArray
) -> RecordedTraffic:
    sizes = dict.fromkeys(who.tolist(), ("pedestrian", *SIZE))
    return on_grid(name, moment, who, (place, velocity, np.arctan2(velocity[:, 1], velocity[:, 0])), sizes)


def recorded_crowds(root: Path) -> Recordings:
    """Windows of the recordings eth and hotel below `root`, each of `WINDOW` s; places are interpolated."""
    dataset, windows = EthUcy(root), {}
    for recording in dataset.scenes:
        scene = dataset.scene(recording)
        for k in range(int((scene.timestamps[-1] - scene.timestamps[0]) // WINDOW)):
            windows[f"{recording}-{k:02d}"] = (recording, scene.timestamps[0] + k * WINDOW)

    def read(name: str) -> RecordedTraffic:
        recording, start = windows[name]
        scene = dataset.scene(recording)
        assert scene.ground_truth is not None
        time = np.concatenate([[t] * len(a) for t, a in zip(scene.timestamps, scene.ground_truth, strict=True)])
        who = np.concatenate([a.id for a in scene.ground_truth])
        place = np.concatenate([a.boxes.position[:, :2] for a in scene.ground_truth])
        velocity = np.concatenate([a.boxes.velocity for a in scene.ground_truth])
        rows = []
        for one in np.unique(who):
            own = np.flatnonzero((who == one) & np.isfinite(velocity).all(axis=1))
            t, x, v = time[own] - start, place[own], velocity[own]
            for i in np.flatnonzero(np.diff(t) < GAP):
                k = np.arange(np.ceil(t[i] / PERIOD - 1e-6), np.ceil(t[i + 1] / PERIOD - 1e-6)).astype(np.int64)
                k = k[(k >= 0) & (k * PERIOD <= WINDOW)]
                h = t[i + 1] - t[i]
                s = ((k * PERIOD - t[i]) / h)[:, None]
                at = (
                    (2 * s**3 - 3 * s**2 + 1) * x[i]
                    + (s**3 - 2 * s**2 + s) * h * v[i]
                    + (3 * s**2 - 2 * s**3) * x[i + 1]
                    + (s**3 - s**2) * h * v[i + 1]
                )
                rows.append((k, np.full(len(k), one), at, (1 - s) * v[i] + s * v[i + 1]))
        moment, names, at, speed = (np.concatenate(column) for column in zip(*rows, strict=True))
        return _pedestrians(name, moment, names, at, speed)

    return Recordings(tuple(windows), read)
