"""Labelled objects as one table, and their places between labels."""

import numpy as np
import pytest

from saga_fg import Boxes, InputError
from saga_fg.types.dataset import Annotations, LabelledObjects, Scene


def scene(truth: bool = True) -> Scene:
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
    objects = LabelledObjects.from_scene(scene())
    assert objects.id.tolist() == ["a", "b"]
    assert objects.label.tolist() == ["bus", "car"]
    assert objects.length.tolist() == [4, 4]
    assert objects.position[:, 1, 0].tolist() == [0, 1, 2, 3]
    assert np.isnan(objects.position[1:3, 0]).all()
    assert np.isnan(objects.heading).all()


def test_places_between_labels_are_on_a_line_where_these_are_near():
    objects = LabelledObjects.from_scene(scene())
    np.testing.assert_allclose(objects.at(0.25)[1], [0.5, 0])
    np.testing.assert_allclose(objects.at(0.5)[1], [1, 0])
    np.testing.assert_allclose(objects.at(2.5)[0], [10, 3])
    for time in (-0.1, 0.25, 2.0, 2.6):  # before, not labelled next, too far apart, after
        assert np.isnan(objects.at(time)[0]).all()
    assert np.isnan(objects.at(2.0)).all()


def test_a_scene_without_ground_truth_is_refused():
    with pytest.raises(InputError, match="scene s: expected ground truth"):
        LabelledObjects.from_scene(scene(truth=False))
