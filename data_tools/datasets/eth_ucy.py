"""The ETH walking pedestrians: `eth/obsmat.txt` and `hotel/obsmat.txt`, in; `Scene`s with ground truth alone, out.

    frame  person  x  z  y  vx  vz  vy                                 m and m/s in the ground plane, z = 0

A row is a person at an annotated moment, every 0.4 s. Frames count those of the video, of which `eth` has 15 a second
and `hotel` 25, as the velocity columns imply. The scenes have no vehicle (poses are the identity), no frames of
detections and no sizes; the yaw is the course of the velocity column.

Source: Pellegrini, Ess, Schindler, van Gool, You'll Never Walk Alone, ICCV 2009; files as OpenTraj distributes them,
https://github.com/crowdbotp/OpenTraj.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.datasets.annotated import AnnotatedSource
from data_tools.datasets.source import option
from data_tools.files.error_messages import error_context, unknown_name
from data_tools.files.remote_files import local_tree
from data_tools.files.text_tables import read_table
from saga_fg.errors import InputError
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Dataset, Scene

FRAME_RATES = {"eth": 15.0, "hotel": 25.0}  # of the videos, 1/s
_COLUMNS = ("frame", "person", "x", "z", "y", "vx", "vz", "vy")


class EthUcy:
    """The recordings whose folder below `root` has an obsmat.txt: eth, hotel.

    Files are read when asked for. Raises `InputError` for a root without any.
    """

    def __init__(self, root: str | Path) -> None:
        self._root = Path(root)
        self._scenes = tuple(name for name in FRAME_RATES if (self._root / name / "obsmat.txt").is_file())
        if not self._scenes:
            raise InputError(f"{self._root}: expected eth/obsmat.txt or hotel/obsmat.txt, there is neither")

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the recordings."""
        return self._scenes

    def scene(self, name: str) -> Scene:
        """Read a recording; raises `InputError` for an unknown name or a line that is not as above."""
        if name not in self._scenes:
            raise InputError(f"{self._root}: {unknown_name('recording', name, self._scenes)}")
        path = self._root / name / "obsmat.txt"
        table = read_table(path, (len(_COLUMNS),), " ".join(_COLUMNS))
        if not len(table):
            raise InputError(f"{path}: expected rows, there are none")
        frame, person = table.integers(0, "frame", 0), table.integers(1, "person", 0)
        x, y, vx, vy = table.numbers([2, 4, 5, 7], ("x", "y", "vx", "vy")).T
        n = len(table)
        boxes = Boxes(
            np.full(n, "pedestrian"),
            np.stack([x, y, np.zeros(n)], axis=1),
            np.full((n, 3), np.nan),
            np.arctan2(vy, vx),
            np.stack([vx, vy], axis=1),
        )
        order = np.argsort(frame, kind="stable")
        frames, first = np.unique(frame[order], return_index=True)
        truth = []
        for number, rows in zip(frames.tolist(), np.split(order, first[1:]), strict=True):
            with error_context(f"{path}: frame {number}"):
                truth.append(Annotations(person[rows].astype(np.str_), boxes.select(rows), np.ones(len(rows), bool)))
        poses = np.tile(np.eye(4), (len(frames), 1, 1))
        return Scene(name, frames / FRAME_RATES[name], poses, tuple(map(str, frames.tolist())), [], truth)


@dataclass(frozen=True, kw_only=True)
class EthUcySource(AnnotatedSource):
    """ETH/UCY walking pedestrians, annotated every 0.4 s."""

    name = "eth_ucy"
    example = "--dataroot data/eth_ucy --scenes hotel"
    dataroot: str = option("Folder that holds eth/ and hotel/, or its URL.")

    @contextmanager
    def annotated(self) -> Iterator[Dataset]:
        with local_tree(self.dataroot, ["*/obsmat.txt"]) as root:
            yield EthUcy(root)
