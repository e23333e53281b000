"""Dense road traffic: a recording of it is recognised, and others are not."""

import numpy as np
import pandas as pd
import pytest

from saga_fg import TrackerSettings, track
from saga_fg.tables.plausibility import seems_dense_traffic
from saga_fg.tracking.table_tracking import dense_traffic_settings
from tests.saga_fg.traffic_frames import frame

TIMES = np.arange(0.0, 2.0, 0.1)


def queue(count=6, step=1, **fields):
    """Vehicles one behind the other, at 10 m/s."""
    return [
        frame(t, np.stack([10.0 * t - 12.0 * np.arange(count), np.zeros(count)], axis=1), **fields)
        for t in TIMES[::step]
    ]


def moved(t):
    world_T_ego = np.eye(4)
    world_T_ego[0, 3] = 8.0 * t
    return world_T_ego


def test_traffic_seen_from_above_or_from_the_roadside_is_recognised():
    assert "6 vehicles at a time with headings, 10 Hz" in seems_dense_traffic(queue())
    assert "headings, 2 Hz" in seems_dense_traffic(queue(step=5))
    assert seems_dense_traffic(queue(world_T_ego=np.eye(4))), "a sensor with a pose that stands"
    assert seems_dense_traffic([*queue(), frame(1.95, [])]), "an empty frame says nothing"


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param(queue(count=3), id="few"),
        pytest.param(queue(step=10), id="1 Hz"),
        pytest.param(queue(yaw=np.nan), id="no headings"),
        pytest.param(queue(label="pedestrian"), id="a crowd"),
        pytest.param([frame(t, np.full((6, 2), t), world_T_ego=moved(t)) for t in TIMES], id="moves"),
        pytest.param([frame(t, []) for t in TIMES], id="nothing"),
        pytest.param([], id="no frames"),
    ],
)
def test_other_recordings_are_not(frames):
    assert seems_dense_traffic(frames) == ""


def test_a_table_of_it_is_tracked_with_its_settings():
    pandas = pytest.importorskip("pandas")
    rows = [
        {"timestamp": one.timestamp, "label": "car", "x": x, "y": y, "yaw": 0.0}
        for one in queue()
        for x, y in one.detections.boxes.position[:, :2].tolist()
    ]
    table = pandas.DataFrame(rows)
    with pytest.warns(UserWarning, match="settings for dense traffic: 6 vehicles"):
        found = track(table)
    by_name = track(table, dense_traffic_settings())
    assert found.equals(by_name)
    with pytest.warns(UserWarning, match="dense_traffic_settings.. of saga_fg.tracking may fit better"):
        assert not found.equals(track(table, TrackerSettings(min_hits=2)))


def test_detections_without_tracks_are_told():
    """Three cars abreast, once a second: others may have come where each is expected."""
    rows = [(float(k), "car", 5.0 * k, y) for k in range(20) for y in (0.0, 9.0, 18.0)]
    table = pd.DataFrame(rows, columns=["timestamp", "label", "x", "y"])
    with pytest.warns(UserWarning, match=r"60 detections, no track: .*; settings='dense' expects more between frames"):
        assert len(track(table)) == 0
    assert track(table, "dense").id.nunique() == 3
