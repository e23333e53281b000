"""Memory of a frame grows with the number of objects, not with that of their pairs."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.speed_scenes import Ties, speed_config, speed_frames
from pipelines.config import Method

FEW, MANY = 1000, 3000


def peak(count: int, ties: Ties, method: Method) -> int:
    """Largest number of bytes that a frame allocates, once tracks are there; seen from a vehicle."""
    frames = [replace(frame, world_T_ego=np.eye(4)) for frame in speed_frames(count, ties, 4, seed=0)]
    tracker = speed_config(ties).new_tracker(method)
    for frame in frames[:-1]:
        tracker.step(frame)
    tracemalloc.start()
    tracker.step(frames[-1])
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


@pytest.mark.parametrize(("ties", "method"), [("loose", "saga"), ("dense", "saga"), ("loose", "centerpoint")])
def test_no_array_of_a_frame_holds_all_pairs_of_objects(ties: Ties, method: Method) -> None:
    few, many = peak(FEW, ties, method), peak(MANY, ties, method)
    assert many < 3.5 * few  # an array of all pairs, of one byte each, would make it more
    if ties == "loose":
        assert many < 2 * MANY**2  # bytes
