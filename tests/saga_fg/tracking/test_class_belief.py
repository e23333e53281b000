"""Beliefs over classes that sensors confuse, against Bayes' rule written out."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes, Detections, Frame, InputError, Tracker
from saga_fg.model.edge_rules import Attached
from saga_fg.model.motion import ConstantVelocity, RandomWalk
from saga_fg.model.sensor import Sensor
from saga_fg.tracking import ClassSettings, TrackerSettings
from saga_fg.tracking.class_belief import MIN_BELIEF, OUTLIERS, ConfusedClasses
from saga_fg.tracking.measurements import frame_measurements
from saga_fg.tracking.settings import AssociationSettings, TypicalSize

VEHICLES, CYCLES = ("bus", "car", "truck"), ("bicycle", "motorcycle")
GROUPS = (VEHICLES, CYCLES)


def shares(right, *groups):
    return {c: {z: right if z == c else (1 - right) / (len(g) - 1) for z in g} for g in groups for c in g}


SENSORS = {"lidar": Sensor(confusion=shares(0.9, *GROUPS)), "camera": Sensor(confusion=shares(0.6, *GROUPS))}
LIDAR = ConfusedClasses.of(SENSORS, {})
known = st.sampled_from([*VEHICLES, *CYCLES, "pedestrian"])


def frame(time, *found, sensor="lidar", score=0.8, length=4.5):
    """found: (class, x) or (class, x, score)."""
    n = len(found)
    position = np.array([[x, 0.0, 0.0] for _, x, *_ in found]).reshape(-1, 3)
    label = np.array([label for label, *_ in found], dtype=np.str_)
    boxes = Boxes.of(label, position, np.tile([length, 1.9, 1.6], (n, 1)), np.zeros(n), np.zeros((n, 2)))
    return Frame(time, sensor, Detections(boxes, np.array([(*rest, score)[0] for _, _, *rest in found])), np.eye(4))


def tracker(sensors=SENSORS, estimator="kalman", **classes):
    plain = {"default": ClassSettings(initial_speed_deviation=1.0), **classes}
    return Tracker(TrackerSettings(plain, estimator=estimator, tentative_score_factor=1.0), sensors)


def beliefs(confused, row):
    return dict(zip(confused.classes, np.exp(row).tolist(), strict=True))


@given(st.lists(st.tuples(st.sampled_from(sorted(SENSORS)), known), min_size=1, max_size=8))
def test_a_belief_is_the_product_of_the_reports(reports):
    first = reports[0][1]
    mates = next((group for group in GROUPS if first in group), ())
    reports = [(sensor, label) for sensor, label in reports if label in mates or label == first]
    belief = None
    for sensor, label in reports:
        likelihood = LIDAR.likelihood(sensor, np.array([label]))
        belief = LIDAR.initial(likelihood) if belief is None else LIDAR.updated(belief, likelihood)
    expected = dict.fromkeys(mates, 1.0)
    for sensor, label in reports:
        table = SENSORS[sensor].confusion
        expected = {c: p * table[c][label] for c, p in expected.items()}
        total = sum(expected.values())
        raised = {c: max(p / total, MIN_BELIEF) for c, p in expected.items()}
        expected = {c: p / sum(raised.values()) for c, p in raised.items()}
    found = beliefs(LIDAR, belief[0])
    for label in LIDAR.classes:
        assert found[label] == pytest.approx(expected.get(label, 0.0), abs=1e-12)


def test_counts_and_missing_tables_and_rows_say_how_sure_a_sensor_is():
    counts = {"car": {"car": 900.0, "truck": 100.0}, "truck": {"truck": 90.0, "car": 10.0}}
    confused = ConfusedClasses.of({"lidar": Sensor(confusion=counts)}, {})
    found = beliefs(confused, confused.initial(confused.likelihood("lidar", np.array(["truck"])))[0])
    assert found["car"] == pytest.approx(1000 * 0.1 / (1000 * 0.1 + 100 * 0.9))
    chance = confused.log_evidence(
        confused.initial(confused.likelihood("lidar", np.array(["truck"]))), np.array([[0.9, 0.1]])
    )
    assert np.exp(chance[0]) == pytest.approx(found["car"] * 0.9 + found["truck"] * 0.1)
    confused = ConfusedClasses.of(SENSORS | {"radar": Sensor()}, {})
    (row,) = confused.likelihood("radar", np.array(["car"]))
    assert row[confused.classes.index("car")] == pytest.approx(1.0, abs=3e-3)
    assert 0 < row[confused.classes.index("bus")] < 2e-3
    assert row[confused.classes.index("bicycle")] == 0
    rows = {"car": {"car": 80.0, "truck": 15.0, "bus": 5.0}, "bus": {"bus": 9.0, "car": 1.0}}
    confused = ConfusedClasses.of({"camera": Sensor(confusion=rows)}, {})
    column = confused.classes.index("truck")
    chance = dict(zip(confused.classes, confused.tables["camera"][:, column].tolist(), strict=True))
    assert chance == pytest.approx({"truck": 0.85, "car": 0.075, "bus": 0.075})


def test_groups_are_chains_of_confusions_and_without_tables_there_are_none():
    confused = ConfusedClasses.of({"lidar": Sensor(), "camera": Sensor(confusion={"car": {"car": 1.0}})}, {})
    assert len(confused) == 0
    assert [n.tolist() for n in confused.numbers(np.array(["car", "bus"]), np.array(["bus"]))] == [[0, 1], [1]]
    rows = {"pedestrian": {"pedestrian": 8.0, "bicycle": 2.0}, "bicycle": {"bicycle": 9.0, "motorcycle": 1.0}}
    confused = ConfusedClasses.of({"lidar": Sensor(confusion=rows)}, {})
    (number,) = confused.numbers(np.array(["pedestrian", "car", "motorcycle", "bicycle"]))
    assert number[0] == number[2] == number[3] != number[1]


def test_a_belief_can_always_be_changed():
    car, bus = (LIDAR.likelihood("lidar", np.array([label])) for label in ("car", "bus"))
    belief, label = LIDAR.initial(car), np.array(["car"])
    for _ in range(200):
        belief = LIDAR.updated(belief, car)
    assert math.exp(belief[np.isfinite(belief)].min()) >= 0.9 * MIN_BELIEF
    reported = []
    for _ in range(4):
        belief = LIDAR.updated(belief, bus)
        reported.append(str(LIDAR.labels(belief, label)[0]))
    assert reported == ["car", "car", "bus", "bus"]  # after log(1 / MIN_BELIEF) / log(0.9 / 0.05) detections


def test_size_and_speed_count_once_by_their_densities():
    sizes = {"car": TypicalSize(4.5, 1.9, 1.7, 0.1), "truck": TypicalSize(8.0, 2.5, 3.2, 0.2)}
    speeds = {"car": 8.0, "truck": 5.0}
    classes = {c: ClassSettings(typical_size=s, initial_speed_deviation=speeds[c]) for c, s in sizes.items()}
    confused = ConfusedClasses.of({"lidar": Sensor(confusion=shares(0.7, ("car", "truck")))}, classes)
    size, speed, variance = np.array([[5.5, 2.1, 2.0]]), np.array([9.0]), np.array([4.0])
    belief = confused.initial(confused.likelihood("lidar", np.array(["truck"])))
    odds = math.log(0.3 / 0.7)
    for sign, (label, typical) in zip((1, -1), sizes.items(), strict=True):
        x = np.log(size[0] / [typical.length, typical.width, typical.height]) / typical.spread
        density = math.exp(-0.5 * x @ x) / (math.sqrt(2 * math.pi) * typical.spread) ** 3
        S = classes[label].initial_speed_deviation ** 2 + 4.0
        odds += sign * math.log((1 - OUTLIERS) * density + OUTLIERS)
        odds += sign * (-0.5 * 81 / S - 0.5 * math.log(2 * math.pi * S))
    for _ in range(2):  # nothing is kept
        car, truck = confused.with_shape(belief, size, speed, variance)[0]
        assert car - truck == pytest.approx(odds)
    unknown = confused.with_shape(belief, np.full((1, 3), np.nan), np.array([np.nan]), variance)
    assert unknown == pytest.approx(belief)


def test_boxes_of_one_object_are_one_report():
    p, q = 0.6, 0.4
    measured = frame_measurements(
        frame(0.0, ("car", 20.0, p), ("truck", 20.3, q), ("car", 20.1, 0.5), ("pedestrian", 20.2, 0.3)),
        SENSORS["lidar"],
        {},
        LIDAR,
    )
    assert measured.boxes.label.tolist() == ["car", "pedestrian"]
    o, u = p / (1 - p), q / (1 - q)
    assert measured.probability == pytest.approx([(o + u) / (1 + o + u), 0.3])
    table = SENSORS["lidar"].confusion
    for k, label in enumerate(LIDAR.classes):
        expected = (o * table[label]["car"] + u * table[label]["truck"]) / (o + u) if label in VEHICLES else 0.0
        assert measured.class_likelihood[0, k] == pytest.approx(expected)
    assert not measured.class_likelihood[1].any()


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_sensors_that_disagree_make_one_track_of_the_likelier_class(estimator):
    track = tracker(estimator=estimator, truck=ClassSettings(motion=RandomWalk()))  # another kind of motion
    reported = []
    for k in range(8):  # the camera comes first, and is wrong throughout
        sensor, label = ("camera", "car") if k % 2 == 0 else ("lidar", "truck")
        reported.append(track.step(frame(0.1 * k, (label, 20.0), sensor=sensor)))
    assert [len(t) for t in reported] == [1] * 8
    assert len({int(t.id[0]) for t in reported}) == 1
    assert [t.boxes.label[0] for t in reported] == ["car"] + ["truck"] * 7
    assert reported[-1].score[0] > reported[0].score[0]
    assert track.classes_of(reported[-1].id).tolist() == ["truck"]


@pytest.mark.parametrize(
    ("other", "place", "edges", "left"),
    [
        (("truck", 0.6), 20.0, (), lambda own, surer: 1 - surer),
        (("truck", 0.3), 20.0, (), lambda own, surer: own),
        (("truck", 0.6), 21.5, (), lambda own, surer: own * (1 - surer)),
        (("truck", 0.6), 23.5, (), lambda own, surer: own),
        (("car", 0.6), 21.5, (), lambda own, surer: own),
        (("truck", 0.6), 21.5, (Attached(("truck",), ("car",)),), lambda own, surer: own),
        (("truck", 0.6), 21.5, (Attached(("trailer",), ("car",)),), lambda own, surer: own * (1 - surer)),
    ],
)
def test_boxes_of_other_classes_in_one_place_exclude_each_other(other, place, edges, left):
    def scores(*found):
        plain = ClassSettings(initial_speed_deviation=1.0, nms_distance=0.0)
        track = Tracker(TrackerSettings({"default": plain}, edges=edges, tentative_score_factor=1.0, max_step=0.1))
        for k in range(4):
            reported = track.step(frame(0.1 * k, *found))
        return dict(zip(reported.boxes.position[:, 0].round(1).tolist(), reported.score.tolist(), strict=True))

    far = 60.0 + place
    alone = scores(("car", 19.9, 0.7), (other[0], far, other[1]))
    both = scores(("car", 19.9, 0.7), (other[0], place, other[1]))
    surer = alone[19.9]
    assert both[19.9] == pytest.approx(surer)
    assert both[place] == pytest.approx(left(alone[far], surer))


def test_groups_keep_to_themselves_and_ones_own_class_goes_before_a_nearer_other():
    track = tracker()
    first = track.step(frame(0.0, ("car", 20.0), ("truck", 21.5), ("bicycle", 20.5), ("pedestrian", 20.2), length=1.0))
    later = track.step(frame(0.1, ("truck", 20.9), ("car", 20.3), ("pedestrian", 20.2), length=1.0))
    at = dict(zip(later.boxes.label.tolist(), later.boxes.position[:, 0].tolist(), strict=True))
    assert at["car"] < at["truck"]
    assert set(later.id.tolist()) <= set(first.id.tolist())


def test_a_table_without_the_class_itself_is_refused(subtests):
    for rows in ({"car": {"carr": 0.9, "truck": 0.1}}, {"car": {"car": 0.0, "truck": 1.0}}, {"car": {}}):
        with (
            subtests.test(str(rows)),
            pytest.raises(InputError, match=r"confusion\.car: expected a share above 0 of car"),
        ):
            Sensor(confusion=rows)
    with pytest.raises(InputError, match=r"confusion\.car\.truck: expected a finite number >= 0, got -1"):
        Sensor(confusion={"car": {"car": 1.0, "truck": -1.0}})


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_a_new_track_of_another_kind_of_motion_hands_over(estimator):
    moving, still = (
        ClassSettings(motion=motion, initial_speed_deviation=1.0, max_deviation=5.0)
        for motion in (ConstantVelocity(), RandomWalk())
    )
    sensors = {"lidar": Sensor(confusion=shares(0.8, ("car", "truck")))}
    settings = TrackerSettings({"default": moving, "truck": still}, estimator=estimator, tentative_score_factor=1.0)
    ways = AssociationSettings(clutter_area=0.01, relink_above=1.0), AssociationSettings(relink_above=0.5)
    without, linking = (Tracker(replace(settings, association=way), sensors) for way in ways)
    for k in range(14):
        linking.step(frame(0.1 * k, *[("car", 20.0)] * (k < 6)))
    without.restore(linking.snapshot())
    without.step(frame(1.4, ("truck", 20.3)))
    assert without.assignment.id.tolist() == [2]
    linking.restore(without.snapshot())
    reported = [linking.step(frame(1.5 + 0.1 * k, ("truck", 20.3))) for k in range(6)]
    assert [each.id.tolist() for each in reported] == [[1]] * 6
    assert [str(each.boxes.label[0]) for each in reported] == ["car"] * 3 + ["truck"] * 3
