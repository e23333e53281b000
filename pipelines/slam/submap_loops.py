"""The submaps of a drive and the loops between them, searched for once for every submap, when it is closed.

    search.add(submap, world_T_submap)  ->  loops between this submap and older ones

A loop says where the frame of one submap is in that of another. It enters the running graph as a factor between the two
anchors, under a robust loss.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from data_tools.lidar import Submap
from pipelines.slam.drive import LEAST
from pipelines.slam.submaps import SubmapBuilder, world_T_submap
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import carried_covariance, inverse_transform
from saga_fg.slam.submaps import LoopClosure, LoopSelection, SubmapGraph

_LOG = logging.getLogger(__name__)


class SubmapLoops(Protocol):
    """Keeps what it needs of the submaps: descriptors, points."""

    def add(self, submap: Submap, world_T_submap: FloatArray) -> Sequence[LoopClosure]:
        """Take the next submap and return loops, `first` and `second` numbers of submaps.

        world_T_submap: (number + 1, 4, 4) frames of all submaps so far, as estimated now, this one's last
        """


class ClosedSubmaps:
    """The submaps of a drive so far; search: for loops between them, None for none."""

    def __init__(self, search: SubmapLoops | None) -> None:
        self.submaps, self.loops = list[Submap](), list[LoopClosure]()  # loops are between keyframes
        self._search = search

    def close(self, builder: SubmapBuilder, graph: SubmapGraph, poses: FloatArray) -> Submap:
        """Close the running submap, poses (n, 4, 4) of all keyframes up to its last."""
        submap = builder.close(poses[-len(builder) :])
        self.submaps.append(submap)
        if self._search is not None:
            frames = np.array([world_T_submap(one, poses[one.anchor]) for one in self.submaps])
            found = [self._between_anchors(loop) for loop in self._search.add(submap, frames)]
            graph.close_loops(found)
            anchors = [one.anchor for one in self.submaps]
            self.loops += [replace(one, first=anchors[one.first], second=anchors[one.second]) for one in found]
        return submap

    def judged(self, selection: LoopSelection) -> tuple[list[LoopClosure], list[LoopClosure]]:
        """The loops between keyframes that are true, and those that are false, which a warning counts."""
        kept = selection.kept
        true, false = ([self.loops[row] for row in np.flatnonzero(rows).tolist()] for rows in (kept, ~kept))
        if false:
            _LOG.warning("%d of %d loops contradict the other %d, and are left out", len(false), len(kept), len(true))
        return true, false

    def _between_anchors(self, loop: LoopClosure) -> LoopClosure:
        """A loop between frames of submaps as one between their anchors."""
        first, second = (self.submaps[n].anchor_T_submap for n in (loop.first, loop.second))
        covariance = carried_covariance(second, loop.covariance) + LEAST
        moved = first @ loop.first_T_second @ inverse_transform(second)
        return replace(loop, first_T_second=moved, covariance=covariance)
