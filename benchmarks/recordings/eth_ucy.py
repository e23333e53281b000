"""Walking pedestrians of ETH and UCY: files of annotated places, in; `Scene`s with ground truth alone, out.

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

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.datasets.detection_files import read_detections
from data_tools.datasets.given_tracks import DetectedScenes
from data_tools.datasets.source import ChosenScenes, DatasetSource, option
from data_tools.files import local_copy, local_tree, read_table
from data_tools.trajectories import central_differences
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import IntArray
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
                truth.append(Annotations(person[rows].astype(np.str_), boxes.select(rows), np.ones(len(rows), bool)))
        poses = np.tile(np.eye(4), (len(frames), 1, 1))
        return Scene(name, frames / _frame_rate(name, frame), poses, tuple(map(str, frames.tolist())), [], truth)


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
