"""Beliefs over classes that detectors mistake for each other."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes, Detections, Frame, InputError, Tracker
from saga_fg.model.motion import ConstantAcceleration, ConstantVelocity
from saga_fg.model.sensor import Sensor
from saga_fg.tracking import ClassSettings, TrackerSettings
from saga_fg.tracking.track_table import LEAST_BELIEF, ClassGroups

GROUPS = (("car", "truck", "bus"), ("bicycle", "motorcycle"))
SENSORS = {"lidar": Sensor(class_accuracy=0.9), "camera": Sensor(class_accuracy=0.6)}
labels = st.lists(st.sampled_from(["car", "truck", "bus", "bicycle", "motorcycle", "pedestrian"]), max_size=8)


def frame(time, *found, sensor="lidar"):
    """found: (class, x)."""
    position = np.array([[x, 0.0, 0.0] for _, x in found]).reshape(-1, 3)
    n = len(found)
    boxes = Boxes.of(
        np.array([label for label, _ in found], dtype=np.str_),
        position,
        np.tile([4.5, 1.9, 1.6], (n, 1)),
        np.zeros(n),
        np.zeros((n, 2)),
    )
    return Frame(time, sensor, Detections(boxes, np.full(n, 0.8)), np.eye(4))


def tracker(groups=GROUPS, estimator="kalman"):
    classes = {"default": ClassSettings(initial_speed_deviation=1.0)}
    settings = TrackerSettings(classes, class_groups=groups, estimator=estimator, tentative_score_factor=1.0)
    return Tracker(settings, SENSORS)


@given(labels)
def test_beliefs_are_bayes_rule_within_the_group(reports):
    groups, sensor = ClassGroups(GROUPS), SENSORS["lidar"]
    likelihood = groups.likelihood(np.array(reports, dtype=np.str_), sensor)
    for label, row in zip(reports, likelihood, strict=True):
        mates = next((group for group in GROUPS if label in group), ())
        wrong = 0.1 / max(len(mates) - 1, 1)
        expected = [0.9 if c == label else wrong if c in mates else 0.0 for c in groups.classes]
        assert row == pytest.approx(expected)
    belief = groups.updated(np.zeros_like(likelihood), likelihood)
    inside = likelihood.any(axis=1)
    assert belief[inside] == pytest.approx(likelihood[inside])  # which sums to one, as nothing is known before
    assert not belief[~inside].any()


def test_a_belief_can_always_be_changed():
    groups = ClassGroups(GROUPS[:1])
    car, bus = groups.likelihood(np.array(["car", "bus"]), SENSORS["lidar"])[:, None]
    belief = car
    for _ in range(200):
        belief = groups.updated(belief, car)
    assert belief.min() >= 0.9 * LEAST_BELIEF
    label = np.array(["car"])
    reported = []
    for _ in range(4):
        belief = groups.updated(belief, bus)
        reported.append(str(groups.labels(belief, label)[0]))
    assert reported == ["car", "car", "bus", "bus"]  # after log(1 / LEAST_BELIEF) / log(0.9 / 0.05) detections


def test_between_classes_believed_alike_the_track_keeps_its_own():
    groups = ClassGroups(GROUPS[:1])
    even = np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]])
    kept = groups.labels(even, np.array(["truck", "car", "pedestrian"]))
    assert kept.tolist() == ["truck", "car", "pedestrian"]


def test_a_misspelt_class_in_a_table_of_confusion_is_refused():
    with pytest.raises(InputError, match=r"confusion\.car: expected car among the classes it is taken for"):
        Sensor(confusion={"car": {"carr": 0.9, "truck": 0.1}})


def test_a_table_of_confusion_takes_the_place_of_one_number():
    sensor = Sensor(confusion={"truck": {"truck": 3.0, "car": 1.0}})
    A = sensor.confusion_among(("car", "truck", "bus"))
    assert A.sum(axis=1) == pytest.approx(np.ones(3))
    assert A[0] == pytest.approx([0.9, 0.05, 0.05])
    assert A[1] == pytest.approx([0.25, 0.75, 0.0], abs=1e-3)


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_sensors_that_disagree_make_one_track_of_the_likelier_class(estimator):
    track = tracker(estimator=estimator)
    reported = []
    for k in range(8):  # the camera comes first, and is wrong throughout
        sensor, label = ("camera", "car") if k % 2 == 0 else ("lidar", "truck")
        reported.append(track.step(frame(0.1 * k, (label, 20.0), sensor=sensor)))
    assert [len(t) for t in reported] == [1] * 8
    assert len({int(t.id[0]) for t in reported}) == 1
    assert [t.boxes.label[0] for t in reported] == ["car"] + ["truck"] * 7
    assert reported[-1].score[0] > reported[0].score[0]


def test_without_groups_there_are_two():
    track = tracker(groups=())
    for k in range(4):
        reported = track.step(frame(0.1 * k, (("car", "truck")[k % 2], 20.0)))
    assert sorted(reported.boxes.label.tolist()) == ["car", "truck"]


def test_groups_keep_to_themselves_and_ones_own_class_goes_before_a_nearer_other():
    track = tracker()
    first = track.step(frame(0.0, ("car", 20.0), ("truck", 21.5), ("bicycle", 20.5), ("pedestrian", 20.2)))
    later = track.step(frame(0.1, ("truck", 20.8), ("car", 20.7), ("pedestrian", 20.2)))
    at = dict(zip(later.boxes.label.tolist(), later.boxes.position[:, 0].tolist(), strict=True))
    assert at["car"] < at["truck"]
    assert set(later.id.tolist()) <= set(first.id.tolist())


def test_a_snapshot_holds_the_beliefs():
    track = tracker()
    for k in range(3):
        track.step(frame(0.1 * k, ("car", 20.0)))
    before = track.snapshot()
    runs = []
    for _ in range(2):
        track.restore(copy.deepcopy(before))
        runs.append([track.step(frame(0.3 + 0.1 * k, ("bus", 20.0))).boxes.label[0] for k in range(5)])
    assert runs[0] == runs[1] == ["car", "car", "bus", "bus", "bus"]


@pytest.mark.parametrize("groups", [(("car",),), (("car", "bus"), ("bus", "truck")), (("car", "car"),)])
def test_groups_that_make_no_sense(groups):
    with pytest.raises(InputError, match="class_groups: expected groups of two classes and more"):
        TrackerSettings(class_groups=groups)


def test_classes_of_a_group_move_alike():
    classes = {"default": ClassSettings(motion=ConstantVelocity()), "bus": ClassSettings(motion=ConstantAcceleration())}
    with pytest.raises(InputError, match="expected one kind of motion"):
        TrackerSettings(classes, class_groups=(("car", "bus"),))
