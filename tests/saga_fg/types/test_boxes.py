"""Boxes, and how they overlap. Boxes: columns checked once, moved between frames, cut and joined."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from saga_fg import Boxes, InputError
from saga_fg.numerics.geometry import inverse_transform, wrap_angle, yaw_transform
from saga_fg.types.boxes import bev_iou, iou_3d, paired_bev_iou, paired_iou_3d, touching_pairs

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


def test_no_boxes_and_what_is_left_out():
    boxes = Boxes.of(["car"], [(1, 2, 3)])
    assert len(boxes) == 1
    assert boxes.position.tolist() == [[1.0, 2.0, 3.0]]
    assert np.isnan(boxes.size).all()
    assert np.isnan(boxes.yaw).all()
    assert np.isnan(boxes.velocity).all()
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
        ({"position": [(0, 0, 0)]}, r"position: expected shape \(2, 3\), got \(1, 3\)"),
        ({"position": [(0, 0, 0), (0, NAN, 0)]}, r"position\[1, 1\]: expected a finite number, got nan"),
        (
            {"size": [(1, 1, 1), (4, -2, 1)]},
            r"size\[1\]: expected positive length, width, height in m, got \[4.0, -2.0",
        ),
        ({"size": [(1, 1, 1), (4, 0, 1)]}, r"size\[1\]: expected positive"),
        ({"size": [(1, 1, 1), (np.inf, 1, 1)]}, r"size\[1, 0\]: expected a finite number, or NaN"),
        ({"yaw": [0.0]}, r"yaw: expected shape \(2,\), got \(1,\)"),
        ({"yaw": [0.0, np.inf]}, r"yaw\[1\]: expected a finite number, or NaN for unknown, got inf"),
        ({"velocity": [(0, 0), (0, np.inf)]}, r"velocity\[1, 1\]: expected a finite number, or NaN"),
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


def test_transforms_turn_headings_and_velocities():
    boxes = Boxes.of(["car"], [(2, 0, 0)], yaw=[0.1], velocity=[(3, 1)])
    turned = boxes.transformed(yaw_transform(x=10.0, yaw=np.pi / 2))
    assert turned.position[0] == pytest.approx([10, 2, 0])
    assert turned.yaw[0] == pytest.approx(0.1 + np.pi / 2)
    assert turned.velocity[0] == pytest.approx([-1, 3])
    boxes = Boxes.of(["car"], [(0, 0, 0)], velocity=[(3, NAN)])
    assert np.isnan(boxes.transformed(yaw_transform(yaw=0.3)).velocity).all()


def test_corners_of_known_boxes():
    boxes = Boxes.of(["car", "car"], [(1, 2, 0), (0, 0, 0)], [(4, 2, 1), (4, 2, 1)], [0.0, np.pi / 2])
    front_left, rear_left, rear_right, front_right = boxes.corners()[0].tolist()
    assert (front_left, rear_left, rear_right, front_right) == ([3, 3], [-1, 3], [-1, 1], [3, 1])
    assert boxes.corners()[1] == pytest.approx(np.array([[-1, 2], [-1, -2], [1, -2], [1, 2]]))


@given(tables(), st.data())
def test_rows_by_mask_by_index_and_by_slice_are_the_same(boxes, data):
    mask = data.draw(arrays(np.bool_, len(boxes)))
    rows = np.flatnonzero(mask)
    assert same(boxes.select(mask), boxes.select(rows))
    assert same(boxes.select(mask), boxes.select(rows.tolist()))
    assert same(boxes.select(slice(None)), boxes)
    parts = Boxes.concatenate([boxes.select(mask), boxes.select(~mask)])
    assert same(parts.select(np.argsort(np.argsort(~mask, kind="stable"))), boxes)


# Overlap of oriented boxes: known cases, laws, and a plain polygon clipping as reference


def box(x=0.0, y=0.0, z=0.0, length=4.0, width=2.0, height=1.5, yaw=0.0):
    return Boxes.of(["car"], [(x, y, z)], [(length, width, height)], [yaw])


def clipped(polygon, clip):
    """Area of two convex polygons' intersection (Sutherland and Hodgman), counter-clockwise lists of points."""
    for p, q in zip(clip, clip[1:] + clip[:1], strict=True):
        side = [(q[0] - p[0]) * (v[1] - p[1]) - (q[1] - p[1]) * (v[0] - p[0]) for v in polygon]
        kept = []
        for n, v in enumerate(polygon):
            w, s, t = polygon[(n + 1) % len(polygon)], side[n], side[(n + 1) % len(polygon)]
            if s >= 0:
                kept.append(v)
            if (s > 0 > t) or (s < 0 < t):
                kept.append((v[0] + (w[0] - v[0]) * s / (s - t), v[1] + (w[1] - v[1]) * s / (s - t)))
        polygon = kept
        if not polygon:
            return 0.0
    return area(polygon)


def area(polygon):
    return sum(p[0] * q[1] - p[1] * q[0] for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True)) / 2


def corner_lists(boxes):
    return [[tuple(map(float, c)) for c in footprint] for footprint in boxes.corners()]


boxes = st.builds(
    box,
    x=st.floats(-4, 4),
    y=st.floats(-4, 4),
    z=st.floats(-1, 1),
    length=st.floats(0.3, 8),
    width=st.floats(0.3, 4),
    height=st.floats(0.3, 3),
    yaw=st.one_of(st.floats(-7, 7), st.sampled_from([0.0, math.pi / 2, -math.pi, math.pi / 4, 1e-9, 1e-12])),
)


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        (box(), box(), 1.0),
        (box(yaw=0.7), box(yaw=0.7), 1.0),
        (box(yaw=0.7), box(yaw=0.7 + math.pi), 1.0),
        (box(yaw=0.3), box(yaw=0.3 + 1e-13), 1.0),
        (box(), box(x=4.0), 0.0),  # side by side, an edge shared
        (box(), box(x=2.0), 4 / 12),
        (box(), box(yaw=math.pi / 2), 4 / 12),
        (box(), box(length=2.0, width=1.0), 0.25),  # one inside the other
        (box(), box(x=1.0, y=0.5, length=2.0, width=1.0), 0.25),  # inside, sharing a corner
        (box(length=2, width=2), box(length=2, width=2, yaw=math.pi / 4), 1 / math.sqrt(2)),  # octagon 8 (sqrt 2 - 1)
        (box(), box(x=100.0), 0.0),
    ],
)
def test_known_footprints(a, b, expected):
    assert bev_iou(a, b) == pytest.approx(np.array([[expected]]), abs=1e-10)
    assert paired_bev_iou(a, b) == pytest.approx(np.array([expected]), abs=1e-10)


def test_known_volumes_overlap_and_unknown_ones_nothing():
    assert iou_3d(box(), box(z=0.75)) == pytest.approx(1 / 3)
    assert iou_3d(box(), box(z=1.5)) == pytest.approx(0.0)
    assert iou_3d(box(), box(z=2.0)) == 0.0
    assert iou_3d(box(), box(height=0.5)) == pytest.approx(1 / 3)
    assert np.isnan(paired_bev_iou(box(), box(yaw=NAN))).all()
    unknown = Boxes.of(["car"], [(0, 0, 0)])
    for function in (bev_iou, iou_3d):
        assert function(unknown, box()).tolist() == [[0.0]]
        assert function(Boxes.empty(), box()).shape == (0, 1)
        assert function(box(), Boxes.empty()).shape == (1, 0)


@given(boxes, boxes)
def test_overlaps_are_those_of_clipped_polygons_symmetric_and_bounded(a, b):
    (pa,), (pb,) = corner_lists(a), corner_lists(b)
    common = clipped(pa, pb)
    union = area(pa) + area(pb) - common
    assert paired_bev_iou(a, b)[0] == pytest.approx(common / union, abs=1e-8)
    low = max(a.position[0, 2] - a.size[0, 2] / 2, b.position[0, 2] - b.size[0, 2] / 2)
    high = min(a.position[0, 2] + a.size[0, 2] / 2, b.position[0, 2] + b.size[0, 2] / 2)
    common *= max(0.0, high - low)
    volume = area(pa) * a.size[0, 2] + area(pb) * b.size[0, 2] - common
    assert paired_iou_3d(a, b)[0] == pytest.approx(common / volume, abs=1e-8)
    for function in (paired_bev_iou, paired_iou_3d):
        value = function(a, b)[0]
        assert value == pytest.approx(function(b, a)[0], abs=1e-9)
        assert 0.0 <= value <= 1.0 + 1e-12


def test_all_pairs_are_the_pairs_one_by_one():
    rng = np.random.default_rng(1)

    def crowd(n):
        return Boxes.of(
            ["car"] * n, rng.uniform(-10, 10, (n, 3)) * [1, 1, 0.1], rng.uniform(0.5, 5, (n, 3)), rng.uniform(-4, 4, n)
        )

    a, b = crowd(30), crowd(40)
    rows, columns = (g.ravel() for g in np.meshgrid(range(30), range(40), indexing="ij"))
    for function, paired in ((bev_iou, paired_bev_iou), (iou_3d, paired_iou_3d)):
        matrix = function(a, b)
        assert matrix.ravel() == pytest.approx(paired(a.select(rows), b.select(columns)), abs=1e-12)
        assert (matrix > 0).sum() > 10
    assert len(touching_pairs(a, b)[0]) < 1200
