"""Corrections of labels by a person, as factors: what they change, what they leave, and what does not fit."""

from typing import Any

import numpy as np
import pytest

from saga_fg import InputError, Tracker, TrackerSettings
from saga_fg.smoothing import LabelBuilder, LabelModel, Labels, RecordingLabels
from saga_fg.smoothing.corrections import checked_corrections
from tests.saga_fg.smoothing.test_doubt import drive

CAR = {"time": 5.0, "x": 40.0, "y": 0.0}
PEOPLE = {"time": 2.0, "x": 22.0, "y": 30.0}, {"time": 8.0, "x": 28.0, "y": 30.0}


@pytest.fixture(scope="module")
def builder() -> LabelBuilder:
    settings, frames = TrackerSettings(min_hits=2), drive(swap=True)
    made = LabelBuilder(Tracker(settings), LabelModel(settings))
    made.add(frames, np.array([frame.timestamp for frame in frames]))
    made.finish()
    return made


def moments(labels: RecordingLabels) -> list[Labels]:
    return [moment for part in labels for moment in part]


def corrected(builder: LabelBuilder, *records: dict[str, Any]) -> tuple[list[Labels], list[str]]:
    """Labels with corrections, and problems of those that do not hold."""
    labels, counts = builder.corrected(checked_corrections(records))
    found = moments(labels)
    assert counts.boxes == sum(map(len, found))
    return found, [why for _, why in builder.outcomes if why]


def boxes_of(found: list[Labels], id_: int) -> dict[float, np.ndarray]:
    return {
        m.tracks.timestamp: m.tracks.boxes.position[m.tracks.id == id_][0] for m in found if id_ in m.tracks.id.tolist()
    }


def test_a_box_moves_its_object_and_its_neighbours_in_time(builder):
    plain, _ = corrected(builder)
    box = {"x": 41.0, "y": 0.6, "yaw": np.pi, "length": 6.0, "width": 2.0, "height": 2.0}
    sure = {"position": 0.02, "yaw": 0.02, "size": 0.05}
    found, problems = corrected(builder, {"what": "box", "at": CAR, "box": box, "deviation": sure})
    assert not problems
    before, after = boxes_of(plain, 1), boxes_of(found, 1)
    moved = {time: np.hypot(*(after[time] - before[time])[:2]) for time in before}
    assert np.hypot(*(after[5.0][:2] - [41.0, 0.6])) < 0.1
    assert moved[4.75] > 0.2 < moved[5.25]
    assert moved[0.0] < 0.01 > moved[9.75]
    for moment in found:
        row = moment.tracks.id.tolist().index(1)
        assert moment.tracks.boxes.size[row].tolist() == pytest.approx([6.0, 2.0, 2.0], abs=0.01)  # of the whole track
        assert abs(moment.tracks.boxes.yaw[row]) > 3.0
        away = abs(moment.tracks.timestamp - 5.0)
        assert (moment.source[row] == "corrected") == (away == 0)
        assert (moment.source[row] == "near") == (0 < away <= 1.0)
        assert moment.probability.heading[row] > 0.99
    for other in (3, 4):  # far away
        np.testing.assert_array_equal(list(boxes_of(plain, other).values()), list(boxes_of(found, other).values()))


def test_a_box_that_says_nothing_new_changes_nothing(builder):
    plain, _ = corrected(builder)
    here = boxes_of(plain, 1)[5.0]
    vague = {"what": "box", "at": CAR, "box": {"x": here[0], "y": here[1]}, "deviation": {"position": 100.0}}
    found, _ = corrected(builder, vague)
    for id_ in (1, 2, 3, 4):
        before, after = np.array(list(boxes_of(plain, id_).values())), np.array(list(boxes_of(found, id_).values()))
        np.testing.assert_allclose(before, after, atol=0.01)


def test_whole_objects(builder):
    found, problems = corrected(
        builder,
        {"what": "exists", "at": {"time": 3.0, "x": -6.0, "y": 0.0}, "value": False},
        {"what": "exists", "at": {"time": 1.75, "x": 10.0, "y": -20.0}, "value": True},
        {"what": "class", "at": CAR, "label": "bus"},
        {"what": "size", "at": CAR, "box": {"length": 9.0, "width": 2.5, "height": 3.0}},
    )
    assert not problems
    assert not boxes_of(found, 2)
    bus = [m.tracks.id.tolist().index(1) for m in found]
    assert {str(m.tracks.boxes.label[row]) for m, row in zip(found, bus, strict=True)} == {"bus"}
    assert {tuple(m.tracks.boxes.size[row]) for m, row in zip(found, bus, strict=True)} == {(9.0, 2.5, 3.0)}
    weak = [m for m in found if 5 in m.tracks.id.tolist()]
    assert all(m.probability.exists[m.tracks.id == 5][0] == 1.0 for m in weak)
    assert weak


def test_one_object_is_cut_and_two_become_one(builder):
    cut, problems = corrected(builder, {"what": "same", "at": PEOPLE[0], "and": PEOPLE[1], "value": False})
    assert not problems
    first, second = ({k for k, m in enumerate(cut) if id_ in m.tracks.id.tolist()} for id_ in (3, 10**7))
    assert first
    assert second
    assert max(first) < min(second)
    both = {"what": "same", "at": PEOPLE[0], "and": PEOPLE[1], "value": False}
    later = {"what": "class", "at": PEOPLE[1], "label": "cyclist"}  # of the part after the cut
    cut, problems = corrected(builder, both, later)
    assert not problems
    assert {str(m.tracks.boxes.label[m.tracks.id == 3][0]) for m in cut if 3 in m.tracks.id.tolist()} == {"pedestrian"}
    again = {"what": "same", "at": PEOPLE[0], "and": PEOPLE[1], "value": True}
    joined, problems = corrected(builder, both, again)
    assert problems == ["contradicted by corrections: 2, which comes later and counts"]
    assert not boxes_of(joined, 10**7)
    assert boxes_of(joined, 3).keys() == boxes_of(cut, 3).keys() | boxes_of(cut, 10**7).keys()


def test_a_box_far_from_its_object_is_left_out_and_named(builder):
    plain, _ = corrected(builder)
    far, later = {"x": 540.0, "y": 0.0}, {"x": 64.0, "y": 0.0, "time": 8.0}  # the car drives at 8 m/s
    found, problems = corrected(
        builder, {"what": "box", "at": CAR, "box": far}, {"what": "box", "at": CAR, "box": later}
    )
    assert problems == ["the box is 500.0 m from its object, expected at most 20 m"]
    before, after = boxes_of(plain, 1), boxes_of(found, 1)
    assert before.keys() == after.keys()
    assert all(np.hypot(*(after[time] - before[time])[:2]) < 1.0 for time in before)


def test_what_is_seen_at_two_places_at_once_is_not_one_object(builder):
    plain, _ = corrected(builder)
    cars = {"time": 5.0, "x": 10.0, "y": 0.0}
    found, problems = corrected(builder, {"what": "same", "at": CAR, "and": cars, "value": True})
    assert problems == ["both are seen at the same time, 30.0 m apart: they are two objects"]
    assert [m.tracks.id.tolist() for m in found] == [m.tracks.id.tolist() for m in plain]


def test_a_cut_between_no_two_detections_is_named(builder):
    _, problems = corrected(builder, {"what": "same", "at": CAR, "and": CAR, "value": False})
    assert problems == ["no step between two detections lies between the two times"]


def test_an_object_that_nothing_detected(builder):
    at = {"time": 7.0, "x": 100.0, "y": 100.0}
    places = [{"time": 7.0, "x": 100.0, "y": 100.0}, {"time": 9.0, "x": 104.0, "y": 100.0}]
    found, problems = corrected(builder, *({"what": "box", "at": at, "box": box, "label": "truck"} for box in places))
    assert not problems
    new = boxes_of(found, 10**7)
    assert sorted(new) == [7 + k / 4 for k in range(9)]
    np.testing.assert_allclose(new[8.0][:2], [102.0, 100.0], atol=0.1)
    _, problems = corrected(builder, {"what": "box", "at": at, "box": {"x": 100.0, "y": 100.0}})
    assert problems == ["nor a label for a new one: no object within 2 m"]


def test_an_object_said_to_stand_stands(builder):
    found, _ = corrected(builder, {"what": "standing", "at": {"time": 6.0, "x": 24.0, "y": 30.4}, "until": 8.0})
    there = boxes_of(found, 4)
    path = np.array([there[time] for time in sorted(there) if 6 <= time <= 8])[:, :2]
    assert np.hypot(*(path[-1] - path[0])) < 0.3
    sources = {str(m.source[m.tracks.id == 4][0]) for m in found if 6 <= m.tracks.timestamp <= 8}
    assert sources == {"corrected"}


def test_of_a_standing_object_what_contradicts_it_is_named(builder, caplog):
    """Detections that move on, a box elsewhere in that time, before it or after, and an end beyond the recording."""
    stands = {"what": "standing", "at": {"time": 6.0, "x": 24.0, "y": 30.4}, "until": 8.0}
    box = {"what": "box", "at": {"time": 7.0, "x": 24.0, "y": 30.4}, "box": {"x": 24.0, "y": 33.0}}
    found, problems = corrected(builder, stands, box)
    assert problems == ["contradicted by corrections: 2, which comes later and counts"]
    assert boxes_of(found, 4)[7.0][1] > 32.0
    found, problems = corrected(builder, box, stands)
    assert problems == ["contradicted by corrections: 2, which comes later and counts"]
    assert abs(boxes_of(found, 4)[7.0][1] - 30.4) < 1.0
    (problem,) = corrected(builder, {"what": "standing", "at": CAR, "until": 9.0})[1]
    assert "and more from there: it does not stand" in problem
    (problem,) = corrected(builder, stands | {"until": 900.0, "at": {"time": 9.75, "x": 30.0, "y": 30.0}})[1]
    assert problem.startswith("stands beyond the end of the recording at ")
    _, problems = corrected(builder, {"what": "class", "at": CAR, "label": "caar"})
    assert problems == []
    assert "class caar: taken over, no detection has it" in caplog.text


def test_what_does_not_fit_is_named(builder):
    far, late = {"time": 5.0, "x": 500.0, "y": 0.0}, {"time": 500.0, "x": 40.0, "y": 0.0}
    _, problems = corrected(
        builder,
        {"what": "exists", "at": far, "value": True},
        {"what": "class", "at": late, "label": "bus"},
        {"what": "class", "at": CAR, "label": "bus"},
        {"what": "class", "at": CAR, "label": "truck"},
        {"what": "same", "at": CAR, "and": late, "value": True},
        {"what": "box", "at": CAR, "box": {"x": 40.2, "y": 0.0, "length": 4.0, "width": 2.0, "height": 1.5}},
        {"what": "box", "at": CAR | {"time": 6.0, "x": 48.0}, "box": {"x": 48.2, "y": 0.0}},
        {"what": "box", "at": CAR, "box": {"x": 39.9, "y": 0.0}},
        {"what": "exists", "at": PEOPLE[0], "value": True},
        {"what": "exists", "at": PEOPLE[1], "value": False},
    )
    assert problems == [
        "no object within 2 m",
        "outside the recording",
        "contradicted by corrections: 4, which comes later and counts",
        "no moment within 0.5 s of 500 s",
        "contradicted by corrections: 8, which comes later and counts",
        "contradicted by corrections: 10, which comes later and counts",
    ]


def test_corrections_outlive_another_run_of_the_detector(builder):
    """Other numbers, some detections fewer, all of them moved a bit."""
    settings, rng = TrackerSettings(min_hits=2), np.random.default_rng(5)
    frames = []
    for frame in drive(swap=True):
        d = frame.detections
        order = rng.permutation(len(d))[: max(2, len(d) - int(rng.random() < 0.3))]
        frames.append(type(frame)(frame.timestamp, frame.sensor, d.select(order)))
    again = LabelBuilder(Tracker(settings), LabelModel(settings))
    again.add(frames, np.array([frame.timestamp for frame in frames]))
    again.finish()
    record = {"what": "class", "at": CAR | {"label": "car"}, "label": "bus"}
    for made in (builder, again):
        found, problems = corrected(made, record)
        assert not problems
        (at,) = [m for m in found if m.tracks.timestamp == 5.0]
        bus = at.tracks.boxes.label == "bus"
        assert np.hypot(*(at.tracks.boxes.position[bus][0, :2] - [40.0, 0.0])) < 1.0


PLACE = {"time": 0, "x": 0, "y": 0}
BROKEN = [
    (3, "expected an object with what and at"),
    ({"what": "moved", "at": PLACE}, "what: expected one of exists, class"),
    ({"what": "exists"}, "at: expected time, x, y"),
    ({"what": "exists", "at": PLACE | {"x": float("nan")}}, "at: x: expected a number"),
    ({"what": "exists", "at": PLACE, "value": 1}, "value: expected true or false"),
    ({"what": "exists", "at": PLACE, "colour": "red"}, "colour: expected what, at"),
    ({"what": "class", "at": PLACE}, "label: expected the class"),
    ({"what": "same", "at": PLACE}, "and: expected time, x, y"),
    ({"what": "standing", "at": PLACE, "until": -1}, "until: expected a time from 0 s on"),
    ({"what": "box", "at": PLACE, "box": {"x": 1}}, "box: expected x, y, got x"),
    ({"what": "box", "at": PLACE, "box": {"x": 1, "y": 1, "length": 0}}, "box: length: expected a number from 0.0001"),
    (
        {"what": "box", "at": PLACE, "box": {"x": 1, "y": 1}, "deviation": {"position": 1e-300}},
        "deviation: position: expected a number from 0.0001 on",
    ),
    (
        {"what": "box", "at": PLACE, "box": {"x": 1, "y": 1}, "deviation": {"yaw": 0}},
        "deviation: yaw: expected a",
    ),
    ({"what": "box", "at": PLACE, "box": {"x": 1, "y": 1, "yaw": 90}}, "box: yaw: expected a number, of at most 6.28"),
    ({"what": "size", "at": PLACE, "box": {"length": 1}}, "box: expected length, width, height"),
]


def test_what_is_no_correction_is_refused(subtests):
    for record, expected in BROKEN:
        with subtests.test(expected), pytest.raises(InputError, match=r"^corrections: 1: ") as error:
            checked_corrections([record])
        assert expected in str(error.value)
