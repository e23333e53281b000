"""The reader of Argoverse 2 logs, on files written by hand."""

import numpy as np
import pytest

from data_tools.datasets.argoverse2 import ArgoverseLogs
from saga_fg.errors import InputError

feather = pytest.importorskip("pyarrow.feather", reason="the extra [parquet] is not installed")
pa = pytest.importorskip("pyarrow")

HALF = np.sqrt(0.5)


def boxes():
    """A car that stands 10 m ahead of a vehicle which drives 1 m to the north in between."""
    return {
        "timestamp_ns": [1_000_000_000, 1_100_000_000, 1_100_000_000],
        "track_uuid": ["a", "a", "b"],
        "category": ["REGULAR_VEHICLE", "REGULAR_VEHICLE", "BOLLARD"],
        "length_m": [4.0, 4.0, 0.3],
        "width_m": [2.0, 2.0, 0.3],
        "height_m": [1.5, 1.5, 1.0],
        "qw": [1.0, 1.0, 1.0],
        "qx": [0.0, 0.0, 0.0],
        "qy": [0.0, 0.0, 0.0],
        "qz": [0.0, 0.0, 0.0],
        "tx_m": [10.0, 9.0, 0.0],
        "ty_m": [0.0, 0.0, 2.0],
        "tz_m": [0.0, 0.0, 0.0],
        "num_interior_pts": [5, 5, 0],
    }


def poses():
    """The vehicle heads north: its x is the city's y. One pose more than there are annotated times."""
    return {
        "timestamp_ns": [1_100_000_000, 1_000_000_000, 1_050_000_000],
        "qw": [HALF] * 3,
        "qx": [0.0] * 3,
        "qy": [0.0] * 3,
        "qz": [HALF] * 3,
        "tx_m": [100.0] * 3,
        "ty_m": [1.0, 0.0, 0.5],
        "tz_m": [0.0] * 3,
    }


def write(root, annotations, ego):
    folder = root / "log"
    folder.mkdir(exist_ok=True)
    feather.write_feather(pa.table(annotations), folder / "annotations.feather")
    feather.write_feather(pa.table(ego), folder / "city_SE3_egovehicle.feather")
    return ArgoverseLogs(root)


def test_boxes_come_into_the_city_frame(tmp_path):
    dataset = write(tmp_path, boxes(), poses())
    scene = dataset.scene("log")
    np.testing.assert_allclose(scene.timestamps, [0.0, 0.1])
    first, second = scene.ground_truth
    np.testing.assert_allclose(first.boxes.position, [[100.0, 10.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(second.boxes.position, [[100.0, 10.0, 0.0], [98.0, 1.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(second.boxes.yaw, np.pi / 2)
    np.testing.assert_allclose(second.boxes.velocity[0], 0.0, atol=1e-9)
    assert second.boxes.label.tolist() == ["car", "bollard"]
    assert second.visible.tolist() == [True, False]


def test_a_missing_column_a_missing_pose_and_a_broken_file_are_named(tmp_path):
    annotations = boxes()
    del annotations["category"]
    with pytest.raises(InputError, match=r"annotations.feather: category: expected this column"):
        write(tmp_path, annotations, poses()).scene("log")
    ego = {name: column[1:] for name, column in poses().items()}
    with pytest.raises(InputError, match=r"expected a pose at every annotated time, 1100000000 has none"):
        write(tmp_path, boxes(), ego).scene("log")
    dataset = write(tmp_path, boxes() | {"length_m": ["long"] * 3}, poses())
    with pytest.raises(InputError, match=r"annotations.feather: length_m: expected numbers, got object"):
        dataset.scene("log")
    dataset = write(tmp_path, boxes() | {"track_uuid": ["a", None, "b"]}, poses())
    with pytest.raises(InputError, match=r"annotations.feather: track_uuid: expected a value in every row"):
        dataset.scene("log")
    dataset = write(tmp_path, boxes(), poses())
    path = tmp_path / "log" / "annotations.feather"
    path.write_bytes(path.read_bytes().replace(b"category", b"c\xf9tegory"))
    with pytest.raises(InputError, match=r"annotations.feather: expected a readable Feather file: 'utf-8'"):
        dataset.scene("log")
    path.write_bytes(b"not feather")
    with pytest.raises(InputError, match=r"expected a readable Feather file"):
        dataset.scene("log")


def test_a_root_without_logs_and_an_unknown_log_are_errors(tmp_path):
    with pytest.raises(InputError, match=r"expected LOG/annotations.feather"):
        ArgoverseLogs(tmp_path)
    with pytest.raises(InputError, match=r"unknown log 'other'"):
        write(tmp_path, boxes(), poses()).scene("other")
