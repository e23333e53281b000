"""Memory of smoothing grows with what is there at a time, not with the number of all tracks ever."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from saga_fg.estimators import smoother
from saga_fg.model.edge_rules import Following
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.numerics.arrays import IntArray
from saga_fg.smoothing import (
    Evidence,
    Lifespans,
    ObjectMotion,
    OfflineClass,
    SmoothedEdges,
    StateTable,
    batch_states,
    gather_evidence,
    lifespans_of,
    smooth_states,
)
from saga_fg.tracking import ClassSettings
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame

MOMENTS, CARS = 60, 20  # a queue of cars, 10 m apart
CLASSES = {"default": OfflineClass(acceleration_noise=0.5)}
FEW, MANY = MOMENTS, 3  # moments that a track lasts: 20 tracks ever, or 400


def queue(moments: int) -> Evidence:
    """All cars, seen at every moment."""
    times = 0.5 * np.arange(moments)
    place = np.column_stack([10.0 * np.arange(CARS), np.zeros((CARS, 2))])
    frames = [
        Frame(
            time,
            "lidar",
            Detections(Boxes.of(["car"] * CARS, place + np.array([5.0 * time, 0, 0])), np.full(CARS, 0.9)),
        )
        for time in times.tolist()
    ]
    sensors = {"default": Sensor({"default": NoiseModel(position=0.1)})}
    return gather_evidence(frames, times, sensors, {"default": ClassSettings(nms_distance=0.0)})


def tracks(evidence: Evidence, length: int) -> tuple[IntArray, Lifespans]:
    """The track of each detection, where a car gets another one every `length` moments."""
    moments = len(evidence.times)
    object_of = np.tile(np.arange(CARS), moments) * moments + evidence.moment // length
    return object_of, lifespans_of(object_of, evidence.boxes.label, evidence.moment)


def states(evidence: Evidence, length: int, tied: bool = False) -> StateTable:
    object_of, lifespans = tracks(evidence, length)
    V = np.tile(25.0 * np.eye(2), (len(lifespans), 1, 1))
    alone = smooth_states(evidence, object_of, lifespans, ObjectMotion(V, CLASSES))
    if not tied:
        return alone
    rules = (Following(interaction=SharedVelocity()),)
    size = np.zeros(len(lifespans)), np.full(len(lifespans), 4.5)
    edges = SmoothedEdges(rules, float(evidence.times[0]), lifespans, alone, *size)
    return smooth_states(evidence, object_of, lifespans, ObjectMotion(V, CLASSES, edges))


def peak(run: Callable[[], object]) -> int:
    """Largest number of bytes allocated at once."""
    run()  # what is loaded, and kept, once
    tracemalloc.start()
    run()
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


@pytest.mark.parametrize(("kept", "tied"), [("all", False), ("in stretches", True), ("in windows", True)])
def test_states_take_no_more_memory_for_twenty_times_as_many_tracks(
    tied: bool, kept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kept == "in stretches":
        monkeypatch.setattr(smoother, "MOST_KEPT", 300_000)
    if kept == "in windows":
        monkeypatch.setattr(batch_states, "LONG_RECORDING", 5.0)
    evidence = queue(MOMENTS)
    few, many = (peak(lambda length=length: states(evidence, length, tied)) for length in (FEW, MANY))
    assert many < 1.6 * few


def test_in_windows_a_longer_recording_adds_its_rows_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_states, "LONG_RECORDING", 5.0)
    short, long = queue(MOMENTS), queue(3 * MOMENTS)
    more = peak(lambda: states(long, MANY, tied=True)) - peak(lambda: states(short, MANY, tied=True))
    assert more < 1000 * 2 * MOMENTS * CARS  # bytes for each state: its mean, its covariance, and copies of these
