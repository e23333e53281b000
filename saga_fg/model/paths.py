"""Predicted paths of nodes: where others are along the way of a vehicle, and beside it.

A path is a polyline from the node on, and straight beyond both ends. A node without one goes straight along its
heading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from saga_fg.kernels.paths import path_cones, places_along
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, unchecked
from saga_fg.numerics.columns import Columns

SHARP = 1.2  # rad, turn from which nothing is said about where a path is
_ROUNDING = 1 + 1e-9


@dataclass(frozen=True, eq=False)
class Paths(Columns):
    """k paths of m steps: rows (k,) of the nodes, ascending; position (k, m + 1, 2), m; heading (k, m + 1), rad.

    speed, weight    (k, m + 1) typical speed of earlier traffic there, m/s, and the weight of what it is known from,
                     against 1 for no more than one's own speed
    certainty        (k,) from 0 to 1 with which earlier traffic tells the course where the path begins
    disagreement     (k,) variance of its headings there, rad^2
    """

    row: IntArray
    position: FloatArray
    heading: FloatArray
    speed: FloatArray
    weight: FloatArray
    certainty: FloatArray
    disagreement: FloatArray

    def cones(self, most: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Direction (k,) at the start of each path, how far it turns from there, rad, and a margin (k,), m.

        A path that turns by at most a is in a cone of this half angle: places up to `most` m aside of it are no farther
        from that cone than the margin, or the path turns by more than `SHARP`. At a corner a place may be farther from
        the path than aside.
        """
        return _cones(self, most)

    def of_nodes(self, rows: IntArray) -> Paths:
        """The paths of the nodes `rows` (k,), ascending, which are counted from 0 then."""
        place = np.minimum(np.searchsorted(rows, self.row), max(len(rows) - 1, 0))
        kept = (rows[place] == self.row).nonzero()[0] if len(rows) else np.empty(0, dtype=np.int64)
        return unchecked(Paths, **vars(self.select(kept)) | {"row": place[kept]})


NO_PATHS = Paths(
    np.empty(0, dtype=np.int64),
    np.empty((0, 2, 2)),
    np.empty((0, 2)),
    np.empty((0, 2)),
    np.empty((0, 2)),
    np.empty(0),
    np.empty(0),
)


class Along(NamedTuple):
    """Places of E nodes on the paths of others: ahead along the path, m, aside to its left, m, its direction there (E,)
    rad, and whether it is a predicted one."""

    ahead: FloatArray
    aside: FloatArray
    direction: FloatArray
    predicted: BoolArray


def _cones(paths: Paths, most: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`Paths.cones`."""
    return path_cones(paths.position, most, SHARP, _ROUNDING)


def along_paths(
    position: FloatArray, heading: FloatArray, paths: Paths | None, target: IntArray, source: IntArray
) -> Along:
    """Places of nodes `source` (E,) on the paths of nodes `target` (E,); position (n, 2), heading (n,) of all nodes."""
    paths, path = NO_PATHS if paths is None else paths, np.full(len(position), -1)
    path[paths.row] = np.arange(len(paths.row))
    return Along(*places_along(position, heading, path, paths.position, target, source))
