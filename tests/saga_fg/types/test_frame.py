"""Frames, tracks, scenes and road maps."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Annotations, Boxes, Detection, Detections, Frame, InputError, Scene, Tracks
from saga_fg.numerics.geometry import Polylines, direction_at, feet, yaw_transform
from saga_fg.types.dataset import LabelledObjects
from saga_fg.types.road_map import Lane, LanesAcross, StopLine
from saga_fg.types.track import KNOWN_SPEED_DEVIATION, known_velocities

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
    range_rate=maybe,
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


def test_an_empty_table_and_one_that_moves():
    assert len(Detections.empty()) == len(Detections.of([])) == 0
    assert list(Detections.empty()) == []
    assert len(Detections.empty().transformed(yaw_transform(1.0))) == 0
    told = Detection("car", (1, 0, 0), score=-3.5, range_rate=-3.0)
    table = Detections.of([told]).transformed(yaw_transform(10, 0, 0, np.pi))
    assert (table.score.tolist(), table.range_rate.tolist()) == ([-3.5], [-3.0])
    assert table.boxes.position[0] == pytest.approx([9, 0, 0])


def test_a_wrong_detection_is_refused(subtests):
    for arguments, message in [
        ({"label": ""}, r"label\[0\]: expected a name"),
        ({"position": (0, 0, NAN)}, r"position\[0, 2\]: expected a finite number, got nan"),
        ({"size": (4, 2, -1)}, r"size\[0\]: expected positive length, width, height"),
        ({"velocity": (np.inf, 0)}, r"velocity\[0, 0\]: expected a finite number, or NaN"),
        ({"score": NAN}, r"score\[0\]: expected a finite number, got nan"),
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
        ({"timestamp": None}, "timestamp: expected a finite number of seconds, got None"),
        ({"timestamp": 10**400}, "timestamp: expected a finite number of seconds"),
        ({"sensor": ""}, "sensor: expected a name, got ''"),
        ({"sensor": 7}, "sensor: expected a name, got 7"),
        ({"coordinates": "moon"}, "coordinates: expected one of world, ego, sensor, got 'moon'"),
        ({"coordinates": "ego"}, "world_T_ego: expected a pose, since the detections are in ego coordinates"),
        ({"coordinates": "sensor"}, "world_T_ego: expected a pose, since the detections are in sensor coordinates"),
        ({"world_T_ego": np.zeros((4, 4))}, "world_T_ego: expected a rigid 4 x 4 transform"),
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


# Tables of tracks


def table(n=2, **columns):
    good = {
        "timestamp": 1.0,
        "id": np.arange(n) + 7,
        "boxes": Boxes.of(["car"] * n, np.arange(3.0 * n).reshape(n, 3), velocity=np.ones((n, 2))),
        "score": np.linspace(0, 1, n),
        "position_covariance": np.stack([k * np.eye(2) for k in range(n)]) if n else np.empty((0, 2, 2)),
        "velocity_covariance": np.ones((n, 2, 2)),
        "coasting": np.zeros(n),
    }
    return Tracks(**(good | columns))


def test_velocities_of_a_large_deviation_are_unknown():
    P = np.array([s**2 * np.eye(2) for s in (0.1, KNOWN_SPEED_DEVIATION, 2.1, np.nan)])
    known = known_velocities(np.ones((4, 2)), P)
    assert np.isfinite(known).all(axis=1).tolist() == [True, True, False, True]


def test_tables_of_tracks_are_selected_read_only_and_may_be_empty():
    tracks = table(3)
    for rows in ([2, 0], np.array([2, 0])):
        assert tracks.select(rows).id.tolist() == [9, 7]
    chosen = tracks.select(np.array([False, True, False]))
    assert chosen.timestamp == 1.0
    assert chosen.id.tolist() == [8]
    assert chosen.position_covariance[0].tolist() == np.eye(2).tolist()
    assert len(tracks.select([])) == 0
    assert tracks.select(slice(1, None)).id.tolist() == [8, 9]
    empty = Tracks.empty(3.0)
    assert (len(empty), empty.timestamp, list(empty)) == (0, 3.0, [])
    assert len(table(0)) == 0
    assert not table().score.flags.writeable
    assert not table().position_covariance.flags.writeable


def test_wrong_columns_are_named(subtests):
    for columns, message in [
        ({"id": [1, 1]}, "id: expected unique ids, 1 occurs more than once"),
        ({"id": [1]}, "id: expected 2 entries, got 1"),
        ({"score": [0.5, np.nan]}, r"score\[1\]: expected a finite number"),
        ({"score": [0.5]}, r"score: expected shape \(2,\)"),
        ({"position_covariance": np.ones((2, 3, 3))}, r"position_covariance: expected shape \(2, 2, 2\)"),
        ({"velocity_covariance": np.full((2, 2, 2), np.inf)}, r"velocity_covariance\[0, 0, 0\]: expected a finite"),
        ({"coasting": [0.0]}, r"coasting: expected shape \(2,\)"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            table(**columns)


# Scenes and annotations: times run forwards, columns fit, and what does not is named with its scene


def annotations(ids=("a", "b"), visible=(True, False)):
    return Annotations(np.array(ids), Boxes.of(["car"] * 2, np.zeros((2, 3))), np.array(visible))


def scene(**columns):
    good = {
        "name": "crossing",
        "timestamps": [0.0, 0.5, 1.0],
        "world_T_ego": np.stack([yaw_transform(k) for k in range(3)]),
        "tokens": ("", "", ""),
        "frames": [Frame(t, s, Detections.empty()) for t, s in ((0.0, "lidar"), (0.0, "camera"), (0.7, "lidar"))],
    }
    return Scene(**(good | columns))


def test_a_scene_knows_its_sensors_and_length_even_if_empty():
    assert scene().sensors == ("camera", "lidar")
    assert len(scene()) == 3
    assert not scene().timestamps.flags.writeable
    assert scene(ground_truth=[annotations()] * 3).ground_truth is not None
    empty = scene(timestamps=[], world_T_ego=[], tokens=(), frames=[])
    assert len(empty) == 0
    assert empty.sensors == ()


def test_what_a_scene_leaves_out_is_nowhere_unnamed_and_visible():
    truth = [dataclasses.replace(annotations(), visible=np.array(True))] * 2
    plain = Scene("crossing", [0.0, 0.5], ground_truth=truth)
    np.testing.assert_array_equal(plain.world_T_ego, [np.eye(4)] * 2)
    assert (plain.tokens, plain.frames) == (("", ""), ())
    assert Annotations(truth[0].id, truth[0].boxes).visible.all()


def test_a_wrong_scene_is_refused(subtests):
    for columns, message in [
        ({"timestamps": [0.0, 0.5, 0.5]}, r"scene crossing: timestamps\[2\]: expected increasing times, time repeats"),
        ({"timestamps": [0.0, 1.0, 0.5]}, r"scene crossing: timestamps\[2\]: .* time runs backwards at 0.500000 s"),
        ({"timestamps": [0.0, np.nan, 1.0]}, r"timestamps\[1\]: expected a finite number, got nan"),
        ({"world_T_ego": np.tile(np.eye(4), (2, 1, 1))}, r"world_T_ego: expected shape \(3, 4, 4\)"),
        ({"world_T_ego": np.tile(2 * np.eye(4), (3, 1, 1))}, r"scene crossing: world_T_ego\[0\]: expected a rigid"),
        ({"tokens": ("",)}, "scene crossing: tokens: expected 3 entries, got 1"),
        ({"ground_truth": []}, "scene crossing: ground_truth: expected 3 entries, got 0"),
        (
            {"frames": [Frame(t, "lidar", Detections.empty()) for t in (0.5, 0.4)]},
            r"scene crossing: frames\[1\]: expected frames in order of time, 0.400000 s comes late",
        ),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            scene(**columns)


def test_annotations_keep_their_columns_and_wrong_ones_are_refused(subtests):
    truth = annotations()
    assert len(truth) == 2
    assert truth.visible.tolist() == [True, False]
    assert len(Annotations(np.array([]), Boxes.empty(), np.array([]))) == 0
    for ids, visible, message in [
        (("a", "a"), (True, True), "id: expected unique object ids"),
        (("a",), (True, True), "id: expected 2 entries, got 1"),
        ((1, 2), (True, True), "id: expected a list of strings"),
        (("a", "b"), (True,), "visible: expected 2 booleans"),
        (("a", "b"), (1, 0), "visible: expected 2 booleans, got int64"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            annotations(ids, visible)


# Labelled objects as one table, and their places between labels


def labelled_scene(truth: bool = True) -> Scene:
    """Object `b` moves by 1 m a step of 0.5 s, `a` is labelled in the first and the last moment alone."""
    time = np.array([0.0, 0.5, 1.0, 2.5])
    moments = []
    for k in range(4):
        ids = ["b"] if k in (1, 2) else ["b", "a"]
        boxes = Boxes.of(
            ["car", "bus"][: len(ids)], [[k, 0.0, 0.0], [10.0, k, 0.0]][: len(ids)], [[4, 2, 1.5]] * len(ids)
        )
        moments.append(Annotations(np.array(ids), boxes, np.ones(len(ids), dtype=bool)))
    return Scene("s", time, np.tile(np.eye(4), (4, 1, 1)), ("",) * 4, (), tuple(moments) if truth else None)


def test_the_table_has_all_objects_at_all_moments():
    objects = LabelledObjects.from_scene(labelled_scene())
    assert objects.id.tolist() == ["a", "b"]
    assert objects.label.tolist() == ["bus", "car"]
    assert objects.length.tolist() == [4, 4]
    assert objects.position[:, 1, 0].tolist() == [0, 1, 2, 3]
    assert np.isnan(objects.position[1:3, 0]).all()
    assert np.isnan(objects.heading).all()


def test_places_between_labels_are_on_a_line_where_these_are_near():
    objects = LabelledObjects.from_scene(labelled_scene())
    np.testing.assert_allclose(objects.at(0.25)[1], [0.5, 0])
    np.testing.assert_allclose(objects.at(0.5)[1], [1, 0])
    np.testing.assert_allclose(objects.at(2.5)[0], [10, 3])
    for time in (-0.1, 0.25, 2.0, 2.6):  # before, not labelled next, too far apart, after
        assert np.isnan(objects.at(time)[0]).all()
    assert np.isnan(objects.at(2.0)).all()


def test_a_scene_without_ground_truth_is_refused():
    with pytest.raises(InputError, match="scene s: expected ground truth"):
        LabelledObjects.from_scene(labelled_scene(truth=False))


# Lanes across stop lines, and feet on many polylines at once

STRAIGHT = Lane("straight", ((-50.0, 0.0), (20.0, 0.0)), width=4.0)
ASIDE = Lane("aside", ((-50.0, 3.0), (0.0, 3.0), (20.0, 5.0)), width=4.0)
BACK = Lane("back", ((20.0, 0.0), (-50.0, 0.0)))
LINE = StopLine("line", (0.0, 5.0), (0.0, -2.0), "light")
FAR = StopLine("far", (200.0, 2.0), (200.0, -2.0), "light")
NOWHERE = StopLine("nowhere", (0.0, 90.0), (0.0, 86.0), "light")


def test_feet_on_many_polylines_are_those_on_each():
    rng = np.random.default_rng(0)
    lines = [np.cumsum(rng.uniform(0.5, 3.0, (k, 2)), axis=0) for k in (2, 7, 3)]
    places = rng.uniform(-3, 15, (60, 2))
    line = rng.integers(0, 3, 60)
    found = Polylines.from_points(lines).feet(line, places)
    for k, each in enumerate(lines):
        mine = line == k
        for column, alone in zip(vars(found).values(), vars(feet(each, places[mine])).values(), strict=True):
            np.testing.assert_allclose(column[mine], alone, atol=1e-12)
        brute = min_distance(each, places[mine])
        inside = (found.s[mine] > 0) & (found.s[mine] < np.hypot(*np.diff(each, axis=0).T).sum())
        np.testing.assert_allclose(np.hypot(*(found.point - places)[mine].T)[inside], brute[inside], atol=2e-3)


def min_distance(line: np.ndarray, places: np.ndarray) -> np.ndarray:
    s = np.linspace(0, 1, 2000)[:, None]
    points = np.concatenate([a + s * (b - a) for a, b in itertools.pairwise(line)])
    return np.hypot(*np.moveaxis(places[:, None] - points, -1, 0)).min(axis=1)


def test_directions_turn_evenly_lanes_cross_and_there_may_be_nothing():
    corner = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    angle = [math.atan2(y, x) for x, y in direction_at(corner, np.array([-5.0, 5.0, 10.0, 15.0, 40.0]))]
    assert angle == pytest.approx([0, 0, math.pi / 4, math.pi / 2, math.pi / 2])
    across = LanesAcross.from_lanes((STRAIGHT, BACK, ASIDE), (LINE, FAR, NOWHERE))
    assert len(across.centre) == 2  # nothing crosses a line against its direction
    pairs = list(zip(across.line.tolist(), across.lane.tolist(), across.s.tolist(), strict=True))
    assert [pair[:2] for pair in pairs] == [(0, 0), (0, 1), (1, 0)]  # a lane runs on straight beyond its end
    assert [pair[2] for pair in pairs] == pytest.approx([50, 50, 250])
    assert across.e[:2] == pytest.approx([1.5, -1.5])
    for lanes, lines in (((), ()), ((STRAIGHT,), ()), ((), (LINE,))):
        across = LanesAcross.from_lanes(lanes, lines)
        assert len(across.line) == 0
        assert len(across.inside(np.zeros((3, 2)), np.zeros((3, 2))).vehicle) == 0
        assert len(across.crossings(np.array([0, 0]))[0]) == 0


def test_a_line_that_was_moved_is_crossed_elsewhere():
    across = LanesAcross.from_lanes((STRAIGHT,), (LINE, FAR))
    moved = across.placed(np.array([100.0, 0.0]), np.array([[2.0, 0.5], [0.0, 0.0]]), np.array([7, 9]))
    assert moved.line.tolist() == [7, 9]
    assert moved.s == pytest.approx([52, 250])
    assert moved.e == pytest.approx([2.0, 0.0])
    rows, pairs = moved.crossings(np.array([9, 8, 7, 9]))
    assert (rows.tolist(), pairs.tolist()) == ([0, 2, 3], [1, 0, 1])
    there = moved.inside(
        np.array([[-110.0, 1.0], [-110.0, 2.5], [-160.0, 0.0], [-90.0, 1.0]]), np.tile([1.0, 0], (4, 1))
    )
    assert there.vehicle.tolist() == [0, 3]  # within the width, and on the lane
    assert there.feet.s == pytest.approx([40, 60])
    assert there.feet.e == pytest.approx([1, 1])
    assert len(moved.inside(np.array([[-110.0, 1.0]]), np.array([[-1.0, 0.0]])).vehicle) == 0
