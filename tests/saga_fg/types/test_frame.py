"""Detections and frames: a table and its rows are the same thing; what is wrong is named."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes, Detection, Detections, Frame, InputError
from saga_fg.numerics.geometry import yaw_transform

NAN = float("nan")
metres = st.floats(-1e4, 1e4)
maybe = st.one_of(st.just(NAN), st.floats(-3, 3))
length = st.one_of(st.just(NAN), st.floats(0.1, 20))

detections = st.builds(
    Detection,
    label=st.sampled_from(["car", "pedestrian"]),
    position=st.tuples(metres, metres, metres),
    size=st.tuples(length, length, length),
    yaw=maybe,
    velocity=st.tuples(maybe, maybe),
    score=st.floats(-10, 10),
)


def fields(detection):
    """Comparable with ==, NaN included."""
    return repr(dataclasses.astuple(detection))


@given(st.lists(detections, max_size=5))
def test_a_table_is_its_rows(rows):
    table = Detections.of(rows)
    assert len(table) == len(rows)
    assert [fields(d) for d in table] == [fields(dataclasses.replace(d, yaw=table[k].yaw)) for k, d in enumerate(rows)]
    assert np.allclose(table.boxes.yaw, [d.yaw for d in rows], equal_nan=True)
    again = Detections.of(list(table))
    assert [fields(d) for d in again] == [fields(d) for d in table]


@given(st.lists(detections, min_size=1, max_size=5), st.data())
def test_selected_rows(rows, data):
    table = Detections.of(rows)
    chosen = data.draw(st.lists(st.integers(0, len(rows) - 1)))
    assert [fields(d) for d in table.select(chosen)] == [fields(table[k]) for k in chosen]
    mask = np.isin(np.arange(len(rows)), chosen)
    assert [fields(d) for d in table.select(mask)] == [fields(table[k]) for k in sorted(set(chosen))]
    assert len(table.select(slice(0, 1))) == 1


def test_an_empty_table():
    assert len(Detections.empty()) == len(Detections.of([])) == 0
    assert list(Detections.empty()) == []
    assert len(Detections.empty().transformed(yaw_transform(1.0))) == 0


def test_scores_stay_when_the_boxes_move():
    table = Detections.of([Detection("car", (1, 0, 0), score=-3.5)]).transformed(yaw_transform(10, 0, 0, np.pi))
    assert table.score.tolist() == [-3.5]
    assert table.boxes.position[0] == pytest.approx([9, 0, 0])


def test_a_wrong_detection_is_refused(subtests):
    for arguments, message in [
        ({"label": ""}, r"label\[0\]: expected a name"),
        ({"label": 3}, "label: expected a list of strings"),
        ({"position": (0, 0)}, r"position: expected shape \(1, 3\), got \(1, 2\)"),
        ({"position": (0, 0, NAN)}, r"position\[0, 2\]: expected a finite number, got nan"),
        ({"position": "here"}, "position: expected numbers"),
        ({"size": (4, 2, -1)}, r"size\[0\]: expected positive length, width, height"),
        ({"yaw": np.inf}, r"yaw\[0\]: expected a finite number, or NaN"),
        ({"velocity": (np.inf, 0)}, r"velocity\[0, 0\]: expected a finite number, or NaN"),
        ({"score": NAN}, r"score\[0\]: expected a finite number, got nan"),
        ({"score": "high"}, "score: expected numbers"),
        ({"score": None}, r"score"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            Detection(**({"label": "car", "position": (0, 0, 0)} | arguments))


def test_as_many_scores_as_boxes():
    with pytest.raises(InputError, match=r"score: expected shape \(1,\), got \(2,\)"):
        Detections(Boxes.of(["car"], [(0, 0, 0)]), [0.5, 0.5])


def test_a_wrong_frame_is_refused(subtests):
    for arguments, message in [
        ({"timestamp": NAN}, "timestamp: expected a finite number of seconds, got nan"),
        ({"timestamp": "0.1"}, "timestamp: expected a finite number of seconds, got '0.1'"),
        ({"timestamp": np.inf}, "timestamp: expected a finite number of seconds, got inf"),
        ({"timestamp": 1.7e18}, "timestamp: expected seconds, got 1.7e\\+18: milli-, micro- or nanoseconds?"),
        ({"timestamp": "noon"}, "timestamp: expected a finite number of seconds, got 'noon'"),
        ({"timestamp": None}, "timestamp: expected a finite number of seconds, got None"),
        ({"sensor": ""}, "sensor: expected a name, got ''"),
        ({"sensor": 7}, "sensor: expected a name, got 7"),
        ({"coordinates": "moon"}, "coordinates: expected one of world, ego, sensor, got 'moon'"),
        ({"coordinates": "ego"}, "world_T_ego: expected a pose, since the detections are in ego coordinates"),
        ({"coordinates": "sensor"}, "world_T_ego: expected a pose, since the detections are in sensor coordinates"),
        ({"world_T_ego": np.zeros((4, 4))}, "world_T_ego: expected a rigid 4 x 4 transform"),
        ({"world_T_ego": np.eye(3)}, r"world_T_ego: expected shape \(4, 4\)"),
        ({"detections": [Detection("car", (0, 0, 0))]}, "detections: expected Detections, got list"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            Frame(**({"timestamp": 0.0, "sensor": "lidar", "detections": Detections.empty()} | arguments))


def test_a_frame_keeps_what_it_is_given():
    frame = Frame(np.float32(1.5), "lidar", Detections.empty(), yaw_transform(1.0).tolist(), "ego", "abc")
    assert frame.timestamp == 1.5
    assert isinstance(frame.timestamp, float)
    assert frame.world_T_ego.shape == (4, 4)
    assert not frame.world_T_ego.flags.writeable
    assert (len(frame), frame.token) == (0, "abc")
