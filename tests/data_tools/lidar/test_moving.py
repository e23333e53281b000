"""Points inside boxes of objects."""

import numpy as np

from data_tools.lidar.scan import inside_boxes
from saga_fg import Boxes


def test_points_in_boxes_are_found() -> None:
    boxes = Boxes.of(["car", "car"], [[10.0, 0, 1], [0, 20, 1]], size=[[4.0, 2, 2], [4.0, 2, 2]], yaw=[0.0, np.pi / 2])
    rows = [[12.2, 0, 1], [12.4, 0, 1], [10, 1.2, 1], [10, 1.4, 1], [0, 22.2, 1], [2.2, 20, 1], [10, 0, 2.4]]
    points = np.array(rows, dtype=float)
    assert inside_boxes(points, boxes).tolist() == [True, False, True, False, True, False, False]
    assert inside_boxes(points, boxes, margin=0.5)[:4].all()
    assert not inside_boxes(points, Boxes.of(["car"], [[12.0, 0, 1]])).any()  # without a size
    assert inside_boxes(np.empty((0, 3)), boxes).shape == (0,)
