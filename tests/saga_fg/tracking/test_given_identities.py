"""Identities that a sensor gives are evidence for the association, no more."""

from __future__ import annotations

import numpy as np
import pytest

from saga_fg import Boxes, Detections, Frame, InputError, Tracker, TrackerSettings
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.identities import GivenIdentities

WALKERS = TrackerSettings({"default": ClassSettings(initial_speed_deviation=1.5)}, edges=())


def meeting(identity: tuple[int, int] = (7, 3), sensor: str = "camera") -> list[Frame]:
    """Two who walk towards each other, turn round where they meet, and go back: by motion alone they have crossed."""
    frames = []
    for time in np.arange(0.0, 6.01, 0.25):
        x = abs(time - 3.0) + 0.05
        boxes = Boxes.of(["pedestrian"] * 2, [[x, 0.0, 0.0], [-x, 0.0, 0.0]])
        numbers = np.array(identity)
        frames.append(Frame(float(time), sensor, Detections(boxes, np.full(2, 0.9), identity=numbers)))
    return frames


def owners(frames: list[Frame], tracker: Tracker | None = None) -> list[list[int]]:
    """The tracks of the detections of each frame, in their order."""
    tracker = Tracker(WALKERS) if tracker is None else tracker
    found = []
    for frame in frames:
        tracker.step(frame)
        order = np.argsort(tracker.assignment.detection)
        found.append(tracker.assignment.id[order].tolist())
    return found


def test_identities_decide_who_turned_round() -> None:
    without = owners(meeting((-1, -1)))
    assert without[0] == without[-1][::-1]  # as if they had gone past each other
    given = owners(meeting())
    assert given[0] == given[-1]


@pytest.mark.parametrize(("sensor", "exchanged"), [("radar", False), ("camera", True)])
def test_numbers_of_one_sensor_say_nothing_about_those_of_another(sensor: str, exchanged: bool) -> None:
    def pair(time: float, sensor: str, numbers: tuple[int, int]) -> Frame:
        boxes = Boxes.of(["pedestrian"] * 2, [[0.0, 0.0, 0.0], [0.55, 0.0, 0.0]])
        return Frame(time, sensor, Detections(boxes, np.full(2, 0.9), identity=np.array(numbers)))

    found = owners([*(pair(0.1 * k, "camera", (0, 1)) for k in range(10)), pair(1.0, sensor, (1, 0))])
    assert (found[-1] == found[0][::-1]) == exchanged


def test_a_number_that_jumps_to_a_distant_object_does_not_take_the_track_along() -> None:
    def frame(time: float, swapped: bool) -> Frame:
        numbers = [1, 0] if swapped else [0, 1]
        boxes = Boxes.of(["car"] * 2, [[5.0 * time, 0.0, 0.0], [5.0 * time, 30.0, 0.0]])
        return Frame(time, "radar", Detections(boxes, np.full(2, 0.9), identity=np.array(numbers)))

    found = owners([frame(0.1 * k, k >= 10) for k in range(20)])
    assert found[-1] == found[0]


def test_numbers_of_dead_tracks_are_forgotten() -> None:
    known = GivenIdentities().updated("radar", np.array([4, 9]), np.array([1, 2]), np.array([1, 2]), 1.0)
    later = known.updated("radar", np.array([9]), np.array([2]), np.array([2]), 1.1)
    assert later.tracks("radar", np.array([4, 9, -1])).tolist() == [-1, 2, -1]
    assert later.tracks("lidar", np.array([9])).tolist() == [-1]
    assert known.exchanged(1, 2).tracks("radar", np.array([4, 9])).tolist() == [2, 1]


def test_a_late_frame_of_a_sensor_does_not_say_who_had_its_numbers_last() -> None:
    number, alive = np.array([4]), np.array([1, 2])
    known = GivenIdentities().updated("radar", number, alive[:1], alive, 1.0)
    known = known.updated("camera", number, alive[1:], alive, 0.8)  # always late, but newer than its own
    known = known.updated("radar", number, alive[1:], alive, 0.9)
    assert [known.tracks(name, number).tolist() for name in ("radar", "camera")] == [[1], [2]]


@pytest.mark.parametrize(
    ("identity", "message"), [([1.0, 2.0], "whole numbers"), ([4, 4], "4 occurs twice"), ([0, -2], "got -2")]
)
def test_identities_that_are_none_are_refused(identity: list[float], message: str) -> None:
    boxes = Boxes.of(["car", "car"], [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    with pytest.raises(InputError, match=message):
        Detections(boxes, np.ones(2), identity=np.array(identity))
