"""Hidden parts of coupled pairs: who is hidden when, what is taken out of the frames, and what the error is of."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.hidden_parts import COUPLED, HIDDEN, hidden_errors, hidings, without_parts
from benchmarks.predictions import FOLLOWED
from data_tools.simulator.trajectories import Trajectories
from saga_fg import Boxes, Detections, Frame
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.track import Tracks

RATE = 10.0
IDS = np.array(["vehicle-003", "trailer-003", "vehicle-007"])  # a truck, what it tows, and a truck that tows nothing
LABELS = np.array(["truck", "trailer", "truck"])
LENGTHS = np.array([[8.0, 2.5, 3.0], [7.0, 2.5, 3.0], [8.0, 2.5, 3.0]])
FIRST = np.array([[0.0, 0.0], [-8.5, 0.0], [0.0, 7.0]])
SPEED = 6.0


def boxes_at(time):
    moved = FIRST + np.array([SPEED * time, 0.0])
    position = np.column_stack([moved, np.full(3, 1.5)])
    return Boxes(LABELS, position, LENGTHS, np.zeros(3), np.tile([SPEED, 0.0], (3, 1)))


def drive(seconds=8.0, visible=(True, True, True)):
    """A scene in which all are detected where they are, and the world it is of."""
    times = np.arange(round(seconds * RATE)) / RATE
    moving = Trajectories(
        IDS,
        LABELS,
        LENGTHS,
        times,
        np.stack([boxes_at(t).position[:, :2] for t in times]),
        np.tile([SPEED, 0.0], (len(times), 3, 1)),
        np.zeros((len(times), 3)),
        np.ones((len(times), 3), dtype=bool),
    )
    frames = tuple(Frame(float(t), "lidar", Detections(boxes_at(t), np.full(3, 0.9))) for t in times)
    truth = tuple(Annotations(IDS, boxes_at(t), np.array(visible)) for t in times)
    scene = Scene("drive", times, np.tile(np.eye(4), (len(times), 1, 1)), ("",) * len(times), frames, truth)
    return scene, SimpleNamespace(objects=moving, start=0.0)


class LastSeen:
    """Every object stays where it was detected last."""

    def __init__(self):
        self._seen = {}

    def step(self, frame):
        for k, box in enumerate(frame.detections.boxes.position):
            lane, label = round(box[1]), str(frame.detections.boxes.label[k])
            self._seen[label, lane] = frame.detections.boxes.select([k])
        return self.tracks(frame.timestamp)

    def tracks(self, timestamp):
        boxes = Boxes.concatenate(list(self._seen.values()))
        n = len(boxes)
        P = np.tile(np.eye(2), (n, 1, 1))
        return Tracks(timestamp, np.arange(n), boxes, np.ones(n), P, P, np.zeros(n))


def test_the_parts_of_pairs_are_hidden_in_turn():
    scene, _ = drive()
    first, second = hidings(scene, COUPLED["towing"])
    assert (first.parts.tolist(), second.parts.tolist()) == (["trailer-003"], ["vehicle-003"])
    assert first.asked.tolist() == first.parts.tolist()
    assert first.start == round(FOLLOWED * RATE)
    assert first.end - first.start == second.end - second.start == round(HIDDEN * RATE)
    assert second.start > first.end


def test_nobody_is_asked_about_a_pair_whose_other_part_is_out_of_view():
    scene, _ = drive(visible=(False, True, True))
    assert [hiding.asked.tolist() for hiding in hidings(scene, COUPLED["towing"])] == [[], []]


def test_only_the_hidden_parts_are_taken_out_of_the_frames():
    scene, world = drive()
    (first, *_) = times = hidings(scene, COUPLED["towing"])
    frames = without_parts(scene, world, times[:1])
    for row, frame in enumerate(frames):
        hidden = first.start < row <= first.end
        assert frame.detections.boxes.label.tolist() == (["truck", "truck"] if hidden else LABELS.tolist())


def test_the_error_is_how_far_the_part_has_gone_from_where_it_is_believed():
    scene, world = drive()
    times = hidings(scene, COUPLED["towing"])
    errors = hidden_errors(scene, without_parts(scene, world, times), LastSeen(), times)
    assert set(errors) == {("trailer-003", times[0].end), ("vehicle-003", times[1].end)}
    assert list(errors.values()) == pytest.approx([SPEED * HIDDEN] * 2)
    seen = hidden_errors(scene, scene.frames, LastSeen(), times)
    assert list(seen.values()) == pytest.approx([0.0, 0.0])


def test_pairs_that_stand_are_not_asked_about():
    scene, _ = drive()
    still = tuple(replace(a, boxes=replace(a.boxes, velocity=np.zeros((3, 2)))) for a in scene.ground_truth)
    assert all(len(h.asked) == 0 for h in hidings(replace(scene, ground_truth=still), COUPLED["towing"]))
