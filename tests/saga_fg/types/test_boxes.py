"""Boxes: columns checked once, moved between frames, cut and joined."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from saga_fg import Boxes, InputError
from saga_fg.numerics.geometry import inverse_transform, wrap_angle, yaw_transform

NAN = float("nan")
COLUMNS = ("label", "position", "size", "yaw", "velocity")
coordinates = st.floats(-1e5, 1e5)


@st.composite
def tables(draw, max_size=5):
    n = draw(st.integers(0, max_size))
    yaw = st.one_of(st.just(NAN), st.floats(-30, 30))
    velocity = draw(arrays(np.float64, (n, 2), elements=st.floats(-30, 30)))
    velocity[draw(arrays(np.bool_, n))] = NAN
    return Boxes.of(
        draw(st.lists(st.sampled_from(["car", "pedestrian", "traffic_cone"]), min_size=n, max_size=n)),
        draw(arrays(np.float64, (n, 3), elements=coordinates)),
        draw(arrays(np.float64, (n, 3), elements=st.one_of(st.just(NAN), st.floats(0.1, 20)))),
        draw(arrays(np.float64, n, elements=yaw)),
        velocity,
    )


def same(a, b, **tolerance):
    assert a.label.tolist() == b.label.tolist()
    for name in COLUMNS[1:]:
        x, y = getattr(a, name), getattr(b, name)
        if name == "yaw":
            assert np.array_equal(np.isnan(x), np.isnan(y))
            x = y + wrap_angle(x - y)
        assert x.shape == y.shape
        assert np.allclose(x, y, equal_nan=True, **tolerance), name
    return True


def test_what_is_left_out_is_unknown():
    boxes = Boxes.of(["car"], [(1, 2, 3)])
    assert len(boxes) == 1
    assert boxes.position.tolist() == [[1.0, 2.0, 3.0]]
    assert np.isnan(boxes.size).all()
    assert np.isnan(boxes.yaw).all()
    assert np.isnan(boxes.velocity).all()


def test_no_boxes():
    for boxes in (Boxes.empty(), Boxes.of([], []), Boxes.of([], [], [], [], []), Boxes.concatenate([])):
        assert len(boxes) == 0
        assert [getattr(boxes, name).shape for name in COLUMNS] == [(0,), (0, 3), (0, 3), (0,), (0, 2)]
        assert boxes.corners().shape == (0, 4, 2)
        assert len(boxes.transformed(yaw_transform(1.0))) == 0


@given(tables())
def test_columns_are_read_only_and_yaw_is_wrapped(boxes):
    for name in COLUMNS:
        assert not getattr(boxes, name).flags.writeable
    known = boxes.yaw[np.isfinite(boxes.yaw)]
    assert ((known >= -np.pi) & (known < np.pi)).all()
    with pytest.raises(dataclasses.FrozenInstanceError):
        boxes.yaw = np.zeros(len(boxes))


def test_wrong_columns_are_named(subtests):
    for columns, message in [
        ({"label": ["car", 1.0]}, None),
        ({"label": ["car", ""]}, r"label\[1\]: expected a name"),
        ({"label": [1, 2]}, "label: expected a list of strings"),
        ({"position": [(0, 0, 0)]}, r"position: expected shape \(2, 3\), got \(1, 3\)"),
        ({"position": [(0, 0), (0, 0)]}, r"position: expected shape \(2, 3\), got \(2, 2\)"),
        ({"position": [(0, 0, 0), (0, NAN, 0)]}, r"position\[1, 1\]: expected a finite number, got nan"),
        ({"position": [(0, 0, 0), (0, 0, np.inf)]}, r"position\[1, 2\]: expected a finite number, got inf"),
        (
            {"size": [(1, 1, 1), (4, -2, 1)]},
            r"size\[1\]: expected positive length, width, height in m, got \[4.0, -2.0",
        ),
        ({"size": [(1, 1, 1), (4, 0, 1)]}, r"size\[1\]: expected positive"),
        ({"size": [(1, 1, 1), (np.inf, 1, 1)]}, r"size\[1, 0\]: expected a finite number, or NaN"),
        ({"yaw": [0.0]}, r"yaw: expected shape \(2,\), got \(1,\)"),
        ({"yaw": [0.0, np.inf]}, r"yaw\[1\]: expected a finite number, or NaN for unknown, got inf"),
        ({"velocity": [(0, 0), (0, np.inf)]}, r"velocity\[1, 1\]: expected a finite number, or NaN"),
        ({"velocity": [(0, 0, 0), (0, 0, 0)]}, r"velocity: expected shape \(2, 2\), got \(2, 3\)"),
    ]:
        with subtests.test(message):
            good = {"label": ["car", "car"], "position": [(0, 0, 0), (1, 0, 0)]}
            if message is None:  # numpy makes strings of them: a label like any other
                assert len(Boxes.of(**(good | columns))) == 2
                continue
            with pytest.raises(InputError, match=message):
                Boxes.of(**(good | columns))


@given(tables(), coordinates, coordinates, st.floats(-10, 10))
def test_a_transform_and_its_inverse_leave_the_boxes(boxes, x, y, yaw):
    target_T_source = yaw_transform(x, y, 0.5, yaw)
    there = boxes.transformed(target_T_source)
    assert same(there.transformed(inverse_transform(target_T_source)), boxes, atol=1e-8)
    assert np.array_equal(there.size, boxes.size, equal_nan=True)


def test_a_transform_turns_heading_and_velocity_with_the_box():
    boxes = Boxes.of(["car"], [(2, 0, 0)], yaw=[0.1], velocity=[(3, 1)])
    turned = boxes.transformed(yaw_transform(x=10.0, yaw=np.pi / 2))
    assert turned.position[0] == pytest.approx([10, 2, 0])
    assert turned.yaw[0] == pytest.approx(0.1 + np.pi / 2)
    assert turned.velocity[0] == pytest.approx([-1, 3])


def test_a_velocity_known_in_one_direction_only_is_unknown_after_a_turn():
    boxes = Boxes.of(["car"], [(0, 0, 0)], velocity=[(3, NAN)])
    assert np.isnan(boxes.transformed(yaw_transform(yaw=0.3)).velocity).all()


def test_corners_of_known_boxes():
    boxes = Boxes.of(["car", "car"], [(1, 2, 0), (0, 0, 0)], [(4, 2, 1), (4, 2, 1)], [0.0, np.pi / 2])
    front_left, rear_left, rear_right, front_right = boxes.corners()[0].tolist()
    assert (front_left, rear_left, rear_right, front_right) == ([3, 3], [-1, 3], [-1, 1], [3, 1])
    assert boxes.corners()[1] == pytest.approx(np.array([[-1, 2], [-1, -2], [1, -2], [1, 2]]))


@given(tables(), st.floats(-5, 5))
def test_corners_move_with_the_box(boxes, yaw):
    T = yaw_transform(3.0, -4.0, 0.0, yaw)
    expected = boxes.corners() @ T[:2, :2].T + T[:2, 3]
    assert np.allclose(boxes.transformed(T).corners(), expected, equal_nan=True, atol=1e-6)


@given(tables(), st.data())
def test_rows_by_mask_by_index_and_by_slice_are_the_same(boxes, data):
    mask = data.draw(arrays(np.bool_, len(boxes)))
    rows = np.flatnonzero(mask)
    assert same(boxes.select(mask), boxes.select(rows))
    assert same(boxes.select(mask), boxes.select(rows.tolist()))
    assert same(boxes.select(slice(None)), boxes)
    parts = Boxes.concatenate([boxes.select(mask), boxes.select(~mask)])
    assert same(parts.select(np.argsort(np.argsort(~mask, kind="stable"))), boxes)


@given(st.lists(tables(), max_size=3))
def test_joining_and_cutting_again(parts):
    joined = Boxes.concatenate(parts)
    start = 0
    for part in parts:
        assert same(joined.select(slice(start, start + len(part))), part)
        start += len(part)
    assert len(joined) == start
