"""Argoverse 2 logs as recorded traffic: states on the common grid, about the place where the vehicle begins."""

import numpy as np
import pyarrow as pa
from pyarrow import feather

from benchmarks.recordings.argoverse2 import argoverse_logs
from benchmarks.recordings.traffic import PERIOD

SPEED, START = 3.0, np.array([500.0, 80.0])
POSE = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tz_m": 0.0}


def test_vehicles_and_people_stand_about_the_first_pose(tmp_path):
    folder, k = tmp_path / "log", np.arange(12)
    folder.mkdir()
    stamp = 10**15 + k * 100_000_000
    ego = {"timestamp_ns": stamp, "tx_m": START[0] + 0.5 * k, "ty_m": np.full(12, START[1])}
    rows = []
    for name, category, y in (("a", "REGULAR_VEHICLE", 2.0), ("b", "PEDESTRIAN", 4.0), ("c", "BOLLARD", 6.0)):
        place = SPEED * PERIOD * k - 0.5 * k  # in the frame of the vehicle
        about = {"track_uuid": [name] * 12, "category": [category] * 12, "num_interior_pts": [9] * 12}
        size = {"length_m": np.full(12, 4.0), "width_m": np.full(12, 2.0), "height_m": np.full(12, 1.5)}
        rows.append(pa.table({"timestamp_ns": stamp, "tx_m": place, "ty_m": np.full(12, y), **about, **size}))
    for name, table in (("annotations", pa.concat_tables(rows)), ("city_SE3_egovehicle", pa.table(ego))):
        for column, value in POSE.items():
            table = table.append_column(column, pa.array(np.full(len(table), value)))
        feather.write_feather(table, folder / f"{name}.feather")
    recordings = argoverse_logs(tmp_path)
    assert recordings.names == ("log",)
    vehicles = recordings.read("log").vehicles
    assert vehicles.label.tolist() == ["car", "pedestrian"], "what stands for ever is no traffic"
    assert vehicles.present.all()
    np.testing.assert_allclose(vehicles.position[:, 0], np.column_stack([SPEED * PERIOD * k, np.full(12, 2.0)]))
    np.testing.assert_allclose(vehicles.velocity[:, 1], np.tile([SPEED, 0.0], (12, 1)), atol=1e-6)
