"""The part of LiDAR SLAM that finds loops: asked once for every submap, when it is closed.

    search.add(submap, world_T_submap)  ->  loops between this submap and older ones

A loop says where the frame of one submap is in that of another. It enters the running graph as a factor between the two
anchors, under a robust loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from data_tools.lidar import Submap
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.submaps import LoopClosure


class SubmapLoops(Protocol):
    """Keeps what it needs of the submaps: descriptors, points."""

    def add(self, submap: Submap, world_T_submap: FloatArray) -> Sequence[LoopClosure]:
        """Take the next submap and return loops, `first` and `second` numbers of submaps.

        world_T_submap: (number + 1, 4, 4) frames of all submaps so far, as estimated now, this one's last
        """
