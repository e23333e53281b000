"""The benchmark of speed: rows with ratios and growth; memory of a frame grows with the number of objects."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.speed import METHODS, Ties, speed_config, speed_frames
from pipelines.config import Method

FEW, MANY = 1000, 3000


def test_every_method_has_a_row_for_every_case(bench) -> None:
    rows = bench("speed --sizes 5,100,120 --frames 6 --round-trips 2")
    cost = [row for row in rows if row["table"] == "CPU time a frame"]
    cases = [f"{size} {ties}" for ties in ("loose", "dense") for size in (5, 100, 120)]
    assert [(row["case"], row["method"]) for row in cost] == [(c, m) for c in cases for m in METHODS]
    for row in cost:
        base = next(other for other in cost if (other["case"], other["method"]) == (row["case"], "centerpoint"))
        assert row["/ centerpoint"] == pytest.approx(row["ms"] / base["ms"])
        assert 0 < row["ms"] <= row["p99"]
        assert min(row["MB"], row["/ 100 filters"], row["/ SVD"]) > 0
    shares = [row for row in rows if row["table"] == "shares of the stages"]
    assert {row["method"] for row in shares} == {"saga", "kf"}
    for row in shares:
        assert sum(value for value in row.values() if isinstance(value, float)) == pytest.approx(1.0)
    grown = {(row["case"], row["method"]) for row in rows if row["table"] == "growth"}
    assert grown == {(ties, m) for ties in ("loose", "dense") for m in METHODS}
    assert 0 < rows[-1]["p50"] <= rows[-1]["p99"]


@pytest.mark.parametrize("ties", ["loose", "dense"])
def test_all_simulated_objects_are_tracked_and_tied_as_said(ties) -> None:
    tracker = speed_config(ties).new_tracker("saga")
    for frame in speed_frames(60, ties, 12, seed=1):
        tracks = tracker.step(frame)
    assert len(tracks.id) == 60
    assert sum(len(edges.target) for edges in tracker.graph.edges) >= (60 if ties == "dense" else 20)


def test_the_command_asks_for_numbers(refused) -> None:
    assert "--sizes: expected whole numbers >= 1" in refused("speed --sizes", "")


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


@pytest.mark.parametrize(("ties", "method"), [("dense", "saga"), ("loose", "centerpoint")])
def test_no_array_of_a_frame_holds_all_pairs_of_objects(ties: Ties, method: Method) -> None:
    few, many = peak(FEW, ties, method), peak(MANY, ties, method)
    assert many < 3.5 * few  # an array of all pairs, of one byte each, would make it more
    if ties == "loose":
        assert many < 2 * MANY**2  # bytes
