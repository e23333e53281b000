"""Points on moving objects."""

import numpy as np
import pytest

from data_tools.lidar.scan import on_moving_objects
from saga_fg import Boxes, InputError


def test_points_in_boxes_of_moving_objects_are_found() -> None:
    boxes = Boxes.of(["car", "car"], [[10.0, 0, 1], [0, 20, 1]], size=[[4.0, 2, 2], [4.0, 2, 2]], yaw=[0.0, np.pi / 2])
    points = [[12.2, 0, 1], [12.4, 0, 1], [10, 1.2, 1], [10, 1.4, 1], [0, 22.2, 1], [2.2, 20, 1], [10, 0, 2.4]]
    assert on_moving_objects(points, boxes, [1.0, 1.0]).tolist() == [True, False, True, False, True, False, False]
    assert on_moving_objects(points, boxes, [0.1, 0.9]).tolist() == [False, False, False, False, True, False, False]
    assert on_moving_objects(points, boxes, [1.0, 0.0], margin=0.5)[:4].all()
    assert not on_moving_objects(points, boxes, [0.0, 0.0]).any()


def test_boxes_without_a_size_cover_nothing_and_bad_input_is_named() -> None:
    boxes = Boxes.of(["car"], [[0.0, 0, 0]])
    assert not on_moving_objects(np.zeros((3, 3)), boxes, [1.0]).any()
    assert on_moving_objects(np.empty((0, 3)), boxes, [1.0]).shape == (0,)
    with pytest.raises(InputError, match="moving"):
        on_moving_objects(np.zeros((3, 3)), boxes, [1.0, 0.0])
    with pytest.raises(InputError, match="margin: expected metres >= 0"):
        on_moving_objects(np.zeros((3, 3)), boxes, [1.0], margin=-1)
