"""The reader of Argoverse 2 logs, on files written by hand."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from data_tools.datasets.argoverse2 import ArgoverseLogs
from data_tools.datasets.argoverse2.logs import DetectedLogs
from data_tools.datasets.argoverse2.source import SCORED, read_feather_tracks, write_feather_tracks, write_submission
from saga_fg.errors import InputError
from saga_fg.types.boxes import Boxes
from saga_fg.types.track import Tracks
from tests.pipelines.command import done, refused

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


def test_what_is_wrong_in_a_log_is_named(tmp_path, subtests):
    late = {name: column[1:] for name, column in poses().items()}
    for annotations, ego, message in [
        ({"category": None}, poses(), r"annotations.feather: category: expected this column"),
        ({}, late, r"expected a pose at every time of boxes, 1100000000 has none"),
        ({"length_m": ["long"] * 3}, poses(), r"annotations.feather: length_m: expected numbers, got object"),
        ({"track_uuid": ["a", None, "b"]}, poses(), r"annotations.feather: track_uuid: expected a value in every row"),
        ({"track_uuid": [["a"]] * 3}, poses(), r"annotations.feather: track_uuid: row 1: expected text, got .*a"),
        ({}, poses() | {"tx_m": [100.0, np.inf, 100.0]}, r"egovehicle.feather: tx_m ty_m tz_m.*expected a finite numb"),
    ]:
        rows = {name: column for name, column in (boxes() | annotations).items() if column is not None}
        with subtests.test(message), pytest.raises(InputError, match=message):
            write(tmp_path, rows, ego).scene("log")
    dataset, path = write(tmp_path, boxes(), poses()), tmp_path / "log" / "annotations.feather"
    for content in (path.read_bytes().replace(b"category", b"c\xf9tegory"), b"not feather"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"annotations.feather: expected a readable Feather file"):
            dataset.scene("log")


def test_a_root_without_logs_and_an_unknown_log_are_errors(tmp_path):
    with pytest.raises(InputError, match=r"expected LOG/annotations.feather"):
        ArgoverseLogs(tmp_path)
    with pytest.raises(InputError, match=r"nowhere: expected the folder of the logs, there is no such folder"):
        ArgoverseLogs(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"unknown log 'other'"):
        write(tmp_path, boxes(), poses()).scene("other")
    with pytest.raises(InputError, match=rf"this is one log: give {tmp_path}$"):
        ArgoverseLogs(tmp_path / "log")


LOG = "log"


def detections(**changes):
    """The official columns: two boxes at the first annotated time, none at the second."""
    rows = {
        "log_id": [LOG, LOG, "other"],
        "timestamp_ns": [1_000_000_000] * 3,
        "category": ["BOX_TRUCK", "BOLLARD", "BUS"],
        "score": [0.9, 0.4, 0.5],
        "length_m": [8.0, 0.3, 9.0],
        "width_m": [2.5, 0.3, 2.5],
        "height_m": [3.0, 1.0, 3.0],
        "qw": [1.0] * 3,
        "qx": [0.0] * 3,
        "qy": [0.0] * 3,
        "qz": [0.0] * 3,
        "tx_m": [10.0, 3.0, 0.0],
        "ty_m": [0.0, 2.0, 0.0],
        "tz_m": [1.0] * 3,
    }
    return rows | changes


def detected(tmp_path, rows):
    feather.write_feather(pa.table(rows), tmp_path / "found.feather")
    return DetectedLogs(write(tmp_path, boxes(), poses()), tmp_path / "found.feather")


def test_official_detections_are_frames_of_the_vehicle(tmp_path):
    logs = detected(tmp_path, detections())
    assert logs.scenes == (LOG,)
    scene = logs.scene(LOG)
    assert [len(frame) for frame in scene.frames] == [2, 0]  # nothing was found at the second annotated time
    first = scene.frames[0]
    assert first.coordinates == "ego"
    assert first.detections.boxes.label.tolist() == ["truck", "bollard"]
    assert first.detections.score.tolist() == [0.9, 0.4]
    np.testing.assert_allclose(
        first.detections.boxes.transformed(first.world_T_ego).position, [[100, 10, 1], [98, 3, 1]], atol=1e-9
    )
    assert scene.categories[0].tolist() == ["BOX_TRUCK", "BOLLARD"]
    assert scene.ground_truth is not None


def test_a_log_without_annotations_has_the_times_of_its_boxes(tmp_path):
    detected(tmp_path, detections())
    (tmp_path / LOG / "annotations.feather").unlink()
    scene = DetectedLogs(ArgoverseLogs(tmp_path), tmp_path / "found.feather").scene(LOG)
    assert scene.tokens == ("1000000000",)
    assert scene.ground_truth is None


def test_wrong_detections_are_refused(tmp_path, subtests):
    for changes, message in [
        ({"log_id": ["a", "b", "c"]}, "log_id: expected one of the logs, such as log, got a and 2 more"),
        ({"log_id": ["zzz"] * 3}, "log_id: expected one of the logs, such as log, got zzz$"),
        ({"score": [np.nan, 0.4, 0.5]}, "log log: score: expected finite numbers"),
        ({"timestamp_ns": [3, 3, 3]}, "timestamp_ns: expected a pose at every time of boxes, 3 has none"),
        ({"qw": [2.0, 1.0, 1.0]}, "expected a unit quaternion"),
        ({"width_m": [-1.0, 1.0, 1.0]}, "expected positive length, width, height"),
        ({"category": [1, 2, 3]}, "category: expected text, got int64"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            detected(tmp_path, detections(**changes)).scene(LOG)


def tracked(tmp_path):
    """The log and its tracks: the truck of the detections, and a car that nobody detected."""
    scene = detected(tmp_path, detections()).scene(LOG)
    found = Boxes.of(
        ["truck", "car"], [[100.5, 10, 1], [100, 40, 1]], [[8, 2.5, 3], [4, 2, 1.5]], [np.pi / 2] * 2, [[0, 3], [1, 0]]
    )
    known = np.tile(np.eye(2), (2, 1, 1))
    of = [
        Tracks(time, np.array([7, 8]), found, np.array([0.8, 0.3]), known, known, np.zeros(2))
        for time in scene.timestamps.tolist()
    ]
    return scene, of


def test_tracks_in_the_format_of_detections_and_back(tmp_path):
    scene, moments = tracked(tmp_path)
    write_feather_tracks(tmp_path / "tracks.feather", [(scene, moments)])
    table = feather.read_table(tmp_path / "tracks.feather").to_pydict()
    assert table["log_id"] == [LOG] * 4
    assert table["timestamp_ns"] == [1_000_000_000] * 2 + [1_100_000_000] * 2
    assert table["track_id"] == [7, 8] * 2
    assert table["category"] == ["BOX_TRUCK", "REGULAR_VEHICLE"] * 2
    np.testing.assert_allclose([table["tx_m"][0], table["ty_m"][0], table["tz_m"][0]], [10, -0.5, 1], atol=1e-9)
    np.testing.assert_allclose([table["qw"][0], table["qz"][0]], [1, 0], atol=1e-9)
    rows = read_feather_tracks(tmp_path / "tracks.feather", {LOG: scene})
    np.testing.assert_allclose(rows.boxes.position, np.tile(moments[0].boxes.position, (2, 1)))
    np.testing.assert_allclose(rows.boxes.velocity, np.tile(moments[0].boxes.velocity, (2, 1)))
    assert rows.boxes.label.tolist() == ["truck", "car"] * 2
    assert rows.timestamp.tolist() == [0.0, 0.0, 0.1, 0.1]
    with pytest.raises(InputError, match="log log: timestamp_ns: expected times of the log, it has none at 1000000000"):
        read_feather_tracks(tmp_path / "tracks.feather", {LOG: replace(scene, tokens=("1", "2"))})


def test_the_official_submission(tmp_path):
    scene, moments = tracked(tmp_path)
    write_submission(tmp_path / "tracks.pkl", [(scene, moments)])
    logs = pickle.loads((tmp_path / "tracks.pkl").read_bytes())
    assert [frame["timestamp_ns"] for frame in logs[LOG]] == [1_000_000_000, 1_100_000_000]
    frame = logs[LOG][0]
    assert frame["name"].tolist() == ["BOX_TRUCK", "REGULAR_VEHICLE"]
    assert [SCORED[label] for label in frame["label"]] == frame["name"].tolist()
    np.testing.assert_allclose(frame["translation_m"], moments[0].boxes.position)
    np.testing.assert_allclose(frame["ego_translation_m"], [100, 0, 0])
    assert all(len(frame[name]) == 2 for name in ("track_id", "score", "size", "yaw", "velocity_m_per_s"))


def test_the_command_from_detections_to_figures(tmp_path):
    rows = boxes()
    rows = {name: [values[0], values[1]] for name, values in rows.items()}
    write(tmp_path, rows, poses())
    found = {name: rows[name] for name in rows if name not in ("track_uuid", "num_interior_pts")}
    found = found | {"score": [0.9, 0.9], "log_id": [LOG] * 2}
    feather.write_feather(pa.table(found), tmp_path / "found.feather")
    options = ["--dataroot", str(tmp_path), "--detections", str(tmp_path / "found.feather")]

    for name in ("tracks.feather", "tracks.csv", "tracks.pkl"):
        done("track", "argoverse2", *options, "--output", tmp_path / name)
    for name in ("tracks.feather", "tracks.csv"):
        assert "car" in done("evaluate", "argoverse2", tmp_path / name, *options).output
    assert "a .pkl is not read" in refused("evaluate", "argoverse2", tmp_path / "tracks.pkl", *options)
    done("track", "argoverse2", *options, "--output", tmp_path / "run", "--workers", 1)
    assert (tmp_path / "run" / "tracks.feather").read_bytes() == (tmp_path / "tracks.feather").read_bytes()
