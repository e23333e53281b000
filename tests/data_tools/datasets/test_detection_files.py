from __future__ import annotations

import csv
import inspect
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import data_tools.datasets.detection_files
from data_tools.datasets.detection_files import TableImport, read_detections, read_tracks, write_tracks
from data_tools.datasets.detection_files.survey import survey_table
from saga_fg import Boxes, Dataset, InputError, Scene, Tracks
from saga_fg.numerics.geometry import yaw_of

CSV = """\
timestamp,sensor,label,x,y,length,width,yaw,score
0.0,lidar,car,10.2,3.1,4.5,1.9,0.02,0.91
0.0,lidar,pedestrian,4.0,-2.0,,,,0.40
0.1,lidar,,,,,,,
0.1,camera,car,10.5,3.0,,,,0.5
"""

NDJSON = """\
{"timestamp":0, "sensor":"lidar", "label":"car", "x":10.2, "y":3.1, "length":4.5, "width":1.9, "yaw":0.02, "score":0.91}
{"timestamp": 0.0, "sensor": "lidar", "label": "pedestrian", "x": 4, "y": -2, "length": null, "score": 0.40}

{"timestamp": 0.1, "sensor": "lidar"}
{"timestamp": 0.1, "sensor": "camera", "label": "car", "x": 10.5, "y": 3.0, "score": 0.5}
"""

NAN = float("nan")
NPZ: dict[str, Any] = {
    "timestamp": [0.0, 0.0, 0.1, 0.1],
    "sensor": ["lidar", "lidar", "lidar", "camera"],
    "label": ["car", "pedestrian", "", "car"],
    "x": [10.2, 4.0, NAN, 10.5],
    "y": [3.1, -2.0, NAN, 3.0],
    "length": [4.5, NAN, NAN, NAN],
    "width": [1.9, NAN, NAN, NAN],
    "yaw": [0.02, NAN, NAN, NAN],
    "score": [0.91, 0.40, NAN, 0.5],
    "empty": [False, False, True, False],
}


def write(tmp_path: Path, suffix: str, content: Any = None) -> Path:
    path = tmp_path / f"drive{suffix}"
    if suffix == ".npz":
        np.savez(path, **(NPZ if content is None else content))
    else:
        path.write_text({".csv": CSV}.get(suffix, NDJSON) if content is None else content)
    return path


@pytest.mark.parametrize("suffix", [".csv", ".ndjson", ".jsonl", ".npz"])
def test_every_format_says_the_same(tmp_path: Path, suffix: str) -> None:
    data: Dataset = read_detections(write(tmp_path, suffix))
    assert data.scenes == ("drive",)
    scene = data.scene("drive")
    assert scene.timestamps.tolist() == [0.0, 0.1]
    assert scene.tokens == ("", "")
    np.testing.assert_array_equal(scene.world_T_ego, [np.eye(4)] * 2)
    assert [(f.timestamp, f.sensor, len(f)) for f in scene.frames] == [
        (0.0, "lidar", 2),
        (0.1, "camera", 1),
        (0.1, "lidar", 0),  # it looked and saw nothing
    ]
    car, pedestrian = scene.frames[0].detections
    assert (car.label, pedestrian.label) == ("car", "pedestrian")
    assert car.position == (10.2, 3.1, 0.0)
    assert car.size[:2] == (4.5, 1.9)
    assert np.isnan(car.size[2])
    assert (car.yaw, car.score) == (pytest.approx(0.02), 0.91)
    assert np.isnan([*car.velocity, *pedestrian.size, pedestrian.yaw]).all()
    assert scene.frames[0].world_T_ego is None


@pytest.mark.parametrize("suffix", [".csv", ".ndjson", ".npz"])
def test_three_columns_are_enough(tmp_path: Path, suffix: str) -> None:
    content: dict[str, Any] = {
        ".csv": "timestamp,x,y\n7,1,2\n",
        ".ndjson": '{"timestamp": 7, "x": 1, "y": 2}\n',
        ".npz": {"timestamp": [7], "x": [1], "y": [2]},
    }
    (frame,) = read_detections(write(tmp_path, suffix, content[suffix])).scene("drive").frames
    (detection,) = frame.detections
    assert (frame.sensor, frame.coordinates) == ("sensor", "world")
    assert (detection.label, detection.position, detection.score) == ("object", (1.0, 2.0, 0.0), 1.0)


def test_the_examples_of_the_documentation(tmp_path: Path) -> None:
    doc = inspect.getdoc(data_tools.datasets.detection_files) or ""
    examples = re.findall(r"(?:^    .*\n)+", doc, re.MULTILINE)
    table, csv_text, ndjson_text, npz_call = (inspect.cleandoc(text) for text in examples)
    for suffix, text in ((".csv", csv_text), (".ndjson", ndjson_text)):
        frames = read_detections(write(tmp_path, suffix, text)).scene("drive").frames
        assert [len(frame) for frame in frames][-1] == 0
        assert frames[0].detections[0].position == (10.2, 3.1, 0.0)
    arrays = eval(f"dict({npz_call.removeprefix('np.savez(').split(',', 1)[1]}")
    assert [len(f) for f in read_detections(write(tmp_path, ".npz", arrays)).scene("drive").frames] == [1, 0]
    for name in data_tools.datasets.detection_files.columns.COLUMNS:
        assert re.search(rf"\b{name}\b", table) or name == "empty"


def test_several_scenes_may_be_interleaved(tmp_path: Path) -> None:
    text = "scene,timestamp,x,y\nb,5,1,1\na,0,2,2\nb,6,3,3\na,1,4,4\n"
    data = read_detections(write(tmp_path, ".csv", text))
    assert data.scenes == ("b", "a")
    assert data.scene("b").timestamps.tolist() == [5, 6]
    assert data.scene("a").frames[1].detections[0].position == (4.0, 4.0, 0.0)
    with pytest.raises(InputError, match="unknown scene 'c'"):
        data.scene("c")


def test_poses_and_ego_coordinates(tmp_path: Path) -> None:
    text = "timestamp,x,y,coordinates,ego_x,ego_y,ego_yaw\n0,1,1,ego,5,6,0.5\n1,1,1,ego,7,8,-0.5\n1,2,2,ego,7,8,-0.5\n"
    scene = read_detections(write(tmp_path, ".csv", text)).scene("drive")
    np.testing.assert_allclose(scene.world_T_ego[:, :3, 3], [[5, 6, 0], [7, 8, 0]])
    np.testing.assert_allclose(yaw_of(scene.world_T_ego[:, :3, :3]), [0.5, -0.5])
    assert [frame.coordinates for frame in scene.frames] == ["ego", "ego"]
    np.testing.assert_array_equal(scene.frames[1].world_T_ego, scene.world_T_ego[1])


def test_a_file_of_empty_frames_alone(tmp_path: Path) -> None:
    scene = read_detections(write(tmp_path, ".ndjson", '{"timestamp": 0}\n{"timestamp": 1}\n')).scene("drive")
    assert [len(frame) for frame in scene.frames] == [0, 0]


def test_columns_one_does_not_know_are_left_alone(tmp_path: Path) -> None:
    scene = read_detections(write(tmp_path, ".csv", "timestamp,x,y,remark,frame\n0,1,2,,7\n")).scene("drive")
    assert [found.position for found in scene.frames[0].detections] == [(1.0, 2.0, 0.0)]


numbers = st.floats(-1e6, 1e6)
sizes = st.none() | st.floats(1e-3, 1e3)
rows = st.tuples(st.integers(0, 5), st.sampled_from("ab"), st.none() | st.tuples(numbers, numbers, sizes))


@given(st.lists(rows, min_size=1, max_size=12))
def test_csv_and_ndjson_agree(tmp_path_factory: pytest.TempPathFactory, table: list[Any]) -> None:
    folder = tmp_path_factory.mktemp("agree")
    table = sorted(table, key=lambda row: row[0])
    named = [
        {"timestamp": t, "sensor": s} | ({} if box is None else {"x": box[0], "y": box[1], "length": box[2]})
        for t, s, box in table
    ]
    with (folder / "t.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["timestamp", "sensor", "x", "y", "length"])
        writer.writeheader()
        writer.writerows(named)
    (folder / "t.jsonl").write_text("\n".join(map(json.dumps, named)))
    one, other = (read_detections(folder / f"t.{suffix}").scene("t").frames for suffix in ("csv", "jsonl"))
    assert [(f.timestamp, f.sensor) for f in one] == [(f.timestamp, f.sensor) for f in other]
    assert [(f.timestamp, f.sensor) for f in one] == sorted({(t, s) for t, s, _ in table})
    assert sum(map(len, one)) == sum(box is not None for _, _, box in table)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.detections.boxes.position, b.detections.boxes.position)
        np.testing.assert_array_equal(a.detections.boxes.size, b.detections.boxes.size)


HEAD = "timestamp,x,y,z,length,score,label\n0,1,1,1,1,1,car\n"
OPEN_QUOTE = "expected comma-separated values: a quote is opened and not closed on this line"
BROKEN_CSV = [
    ("", "expected a column 'timestamp' and a column 'x' and a column 'y', the columns there are none"),
    ("timestamp,x,y\n", "expected at least one row"),
    ("timestamp,x\n0,1\n", "expected a column 'y', the columns there are timestamp, x"),
    ("timestamp,x,y,lenght\n0,1,1,4\n", "unknown column 'lenght'; did you mean 'length'"),
    ("timestamp,x,x,y\n0,1,1,4\n", "line 1: expected every column once"),
    (HEAD + "1,2\n", "line 3: expected 7 columns, got 2"),
    (HEAD + "\n1,far,1,1,1,1,car\n", "line 4: x: expected a number, got 'far'"),
    (HEAD + "1,nan,1,1,1,1,car\n", "line 3: x: expected a finite number of metres, got nan"),
    (HEAD + "1,1,inf,1,1,1,car\n", "line 3: y: expected a finite number, got inf"),
    (HEAD + "1,1,1e999,1,1,1,car\n", "line 3: y: expected a finite number, got inf"),
    (HEAD + "1,,1,1,1,1,car\n", "line 3: x: expected a finite number of metres, it is left out"),
    (HEAD + "1,1,1,1,-4,1,car\n", "line 3: length: expected a positive number of metres, got -4"),
    (HEAD + "1,1,1,1,0,1,car\n", "line 3: length: expected a positive number of metres, got 0"),
    (HEAD + "1,1,1,1,1,nan,car\n", "line 3: score: expected a finite number, got nan"),
    (HEAD + ",1,1,1,1,1,car\n", "line 3: timestamp: expected a finite number of seconds, it is left out"),
    (HEAD + "-1,1,1,1,1,1,car\n", "line 3: timestamp: expected rows in order of time, time runs backwards at -1.0 s"),
    ("timestamp,x,y,coordinates\n0,1,1,map\n", "line 2: coordinates: expected world, ego or sensor, got 'map'"),
    ("timestamp,x,y,coordinates\n0,1,1,ego\n", "line 2: coordinates: ego needs the columns ego_x, ego_y and ego_yaw"),
    ("timestamp,x,y,ego_x\n0,1,1,3\n", "line 2: ego_y: expected a finite number, since ego_x is given, it is left out"),
    (HEAD + "1,1,1,1,1,1," + "c" * 200_000, "line 3: expected comma-separated values: field larger"),
    (HEAD + "1,1,1,1,1,1," + "c" * 1000, "line 3: label: expected a name of at most 256 characters, got 1000"),
    (HEAD + '1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 1000, f"line 3: {OPEN_QUOTE}"),
    (HEAD + '1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 9 + '1,1,1,1,1,1,car"\n', f"line 3: {OPEN_QUOTE}"),
    (HEAD + '\n1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 10_000, f"line 4: {OPEN_QUOTE}"),
    ('"timestamp,x,y\n0,1,1\n', f"line 1: {OPEN_QUOTE}"),
    (HEAD + '1,1,1,1,1,1,"ca"r\n', "line 3: expected comma-separated values: ',' expected after '\"'"),
    ("timestamp,x,y,empty\n0,1,1,yes\n", "empty: expected an array of booleans, in NumPy archives only"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN_CSV, ids=[message[:50] for _, message in BROKEN_CSV])
def test_broken_csv(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=r"drive\.csv: " + re.escape(message)) as caught:
        read_detections(write(tmp_path, ".csv", text))
    assert "\n" not in str(caught.value)


def test_frame_with_two_poses_or_two_kinds_of_coordinates(tmp_path: Path) -> None:
    poses = "timestamp,x,y,ego_x,ego_y,ego_yaw\n0,1,1,0,0,0\n0,1,1,0,1,0\n"
    with pytest.raises(InputError, match="line 3: ego_x, ego_y, ego_z, ego_yaw: expected one pose at one time"):
        read_detections(write(tmp_path, ".csv", poses)).scene("drive")
    kinds = "timestamp,x,y,ego_x,ego_y,ego_yaw,coordinates\n0,1,1,0,0,0,ego\n0,1,1,0,0,0,world\n"
    with pytest.raises(InputError, match="line 3: coordinates: expected the same in all rows of a frame"):
        read_detections(write(tmp_path, ".csv", kinds)).scene("drive")


FIRST = '{"timestamp": 0, "x": 1, "y": 1}\n'
BROKEN_NDJSON = [
    (FIRST + '{"timestamp": 1, "x"', "line 2: broken or truncated JSON"),
    (FIRST + "[1]", "line 2: expected an object, got '[1]'"),
    (FIRST + '{"timestamp": 1, "x": "2", "y": 1}', "line 2: x: expected a number, got '2'"),
    (FIRST + '{"timestamp": 1, "x": true, "y": 1}', "line 2: x: expected a number, got 'True'"),
    (FIRST + '{"timestamp": 1, "x": [], "y": 1}', "line 2: x: expected a number, got '[]'"),
    (FIRST + '{"timestamp": 1, "x": NaN, "y": 1}', "line 2: x: expected a finite number of metres, got nan"),
    (FIRST + '{"timestamp": 1, "x": 1, "y": 1, "label": 3}', "line 2: label: expected a name, got 3"),
    (FIRST + '{"x": 1, "y": 1}', "line 2: timestamp: expected a finite number of seconds, it is left out"),
    (FIRST + '{"timestamp": 1, "x": 1' + "0" * 400 + ', "y": 1}', "line 2: x: expected a finite number, got inf"),
    (FIRST + "[" * 100_000, "line 2: broken or truncated JSON"),
    ("", "expected at least one row"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN_NDJSON, ids=[message[:50] for _, message in BROKEN_NDJSON])
def test_broken_ndjson(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=r"drive\.ndjson: " + re.escape(message)):
        read_detections(write(tmp_path, ".ndjson", text))


BROKEN_NPZ: list[tuple[dict[str, Any], str]] = [
    ({"x": [1]}, "x: expected shape (4,) as timestamp has, got (1,)"),
    ({"x": [[1]] * 4}, "x: expected shape (4,) as timestamp has, got (4, 1)"),
    ({"x": ["1"] * 4}, "x: expected an array of numbers, got <U1"),
    ({"label": [1] * 4}, "label: expected an array of strings, got int64"),
    ({"empty": [1, 0, 0, 0]}, "empty: expected an array of booleans"),
    ({"empty": [False] * 4}, "row 2: x: expected a finite number of metres, got nan"),
    (
        {"label": np.array(["a", 1, None, "b"], dtype=object)},
        "expected NumPy's format, with plain arrays and no pickled objects",
    ),
]


@pytest.mark.parametrize(("changes", "message"), BROKEN_NPZ, ids=[message[:40] for _, message in BROKEN_NPZ])
def test_broken_npz(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=r"drive\.npz: " + re.escape(message)):
        read_detections(write(tmp_path, ".npz", NPZ | changes))


def test_npz_that_is_none(tmp_path: Path) -> None:
    path = write(tmp_path, ".npz")
    whole = path.read_bytes()
    for content in (b"", b"text", whole[:200], whole[:-30]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"drive\.npz: expected NumPy's format, with plain arrays"):
            read_detections(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(InputError, match="got a single array"):
        read_detections(path)


def test_other_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"drive\.txt: expected a file name that ends in \.csv, \.ndjson"):
        read_detections(tmp_path / "drive.txt")
    for suffix in (".csv", ".ndjson", ".npz"):
        with pytest.raises(InputError, match=rf"drive\{suffix}: cannot be read: No such file"):
            read_detections(tmp_path / f"drive{suffix}")
    (tmp_path / "drive.csv").write_bytes(b"timestamp,x,y\n\xff\xfe")
    with pytest.raises(InputError, match=r"drive\.csv: expected text in UTF-8"):
        read_detections(tmp_path / "drive.csv")


# Tracks out.


def tracks(timestamp: float) -> Tracks:
    boxes = Boxes.of(
        ["car", "pedestrian"],
        [[1, 2, 3], [4, 5, 6]],
        [[4, 2, 1.5], [np.nan] * 3],
        [0.1, np.nan],
        [[3, 0.1], [np.nan, np.nan]],
    )
    covariance = np.array([[[0.1, 0.01], [0.01, 0.2]], [[1, 0], [0, 1]]])
    return Tracks(
        timestamp, np.array([7, 9]), boxes, np.array([0.25, 1 / 3]), covariance, covariance, np.array([0, 0.5])
    )


def scene(name: str = "drive") -> Scene:
    return Scene(name, np.array([0.0, 0.5]), np.tile(np.eye(4), (2, 1, 1)), ("", ""), ())


def test_tracks_as_csv(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    yaw = tracks(0.0).boxes.yaw[0]
    write_tracks(path, [(scene(), [tracks(0.0), Tracks.empty(0.5)])])
    assert path.read_text() == (
        "scene,timestamp,id,label,x,y,z,length,width,height,yaw,vx,vy,score,"
        "cov_xx,cov_xy,cov_yy,cov_vxvx,cov_vxvy,cov_vyvy,coasting\n"
        f"drive,0.0,7,car,1.0,2.0,3.0,4.0,2.0,1.5,{yaw},3.0,0.1,0.25,0.1,0.01,0.2,0.1,0.01,0.2,0.0\n"
        "drive,0.0,9,pedestrian,4.0,5.0,6.0,,,,,,,0.3333333333333333,1.0,0.0,1.0,1.0,0.0,1.0,0.5\n"
    )


def test_tracks_as_ndjson(tmp_path: Path) -> None:
    path = tmp_path / "tracks.jsonl"
    write_tracks(path, [(scene(), [Tracks.empty(0.0), tracks(0.5)])])
    first, second = (json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines())
    assert first["id"] == 7
    assert first["cov_yy"] == 0.2
    assert second == {
        "scene": "drive",
        "timestamp": 0.5,
        "id": 9,
        "label": "pedestrian",
        "x": 4,
        "y": 5,
        "z": 6,
        "score": 1 / 3,
        "cov_xx": 1,
        "cov_xy": 0,
        "cov_yy": 1,
        "cov_vxvx": 1,
        "cov_vxvy": 0,
        "cov_vyvy": 1,
        "coasting": 0.5,
    }


@pytest.mark.parametrize("suffix", [".csv", ".ndjson"])
def test_tracks_can_be_read_as_detections(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"tracks{suffix}"
    write_tracks(path, [(scene(name), [tracks(0.0), tracks(0.5)]) for name in ("a", "b")])
    data = read_detections(path)
    assert data.scenes == ("a", "b")
    read = data.scene("b").frames[1].detections
    for name in ("label", "position", "size", "yaw", "velocity"):
        np.testing.assert_array_equal(getattr(read.boxes, name), getattr(tracks(0.5).boxes, name))
    np.testing.assert_array_equal(read.score, tracks(0.5).score)


@pytest.mark.parametrize("suffix", [".csv", ".ndjson"])
def test_tracks_are_read_as_they_were_written(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"tracks{suffix}"
    write_tracks(path, [(scene(name), [tracks(0.0), tracks(0.5)]) for name in ("a", "b")])
    rows = read_tracks(path)
    assert rows.scene.tolist() == ["a"] * 4 + ["b"] * 4
    assert rows.timestamp.tolist() == [0.0, 0.0, 0.5, 0.5] * 2
    assert rows.id.tolist() == ["7", "9"] * 4
    np.testing.assert_array_equal(rows.boxes.velocity[:2], tracks(0.0).boxes.velocity)
    np.testing.assert_array_equal(rows.position_covariance[:2], tracks(0.0).position_covariance)
    np.testing.assert_array_equal(rows.velocity_covariance[:2], tracks(0.0).velocity_covariance)
    np.testing.assert_array_equal(rows.coasting[:2], tracks(0.0).coasting)


def test_a_table_of_tracks_names_what_is_wrong_in_it(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text("timestamp,x,y\n0,1,2\n")
    with pytest.raises(InputError, match=r"tracks\.csv: expected a column 'id'"):
        read_tracks(path)
    path.write_text("timestamp,id,x,y,cov_xx\n0,1,2,3,4\n0,,2,3,4\n")
    with pytest.raises(InputError, match=r"tracks\.csv: line 3: id: expected a name or a whole number, it is left out"):
        read_tracks(path)
    path.write_text("timestamp,id,x,y,cov_zx\n0,1,2,3,4\n")
    with pytest.raises(InputError, match="unknown column 'cov_zx'; did you mean"):
        read_tracks(path)


def test_tracks_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"out\.xlsx: expected a file name that ends in \.csv"):
        write_tracks(tmp_path / "out.xlsx", [])
    with pytest.raises(InputError, match=r"out\.csv: scene drive: expected tracks for 2 moments, got 1"):
        write_tracks(tmp_path / "out.csv", [(scene(), [tracks(0.0)])])
    assert list(tmp_path.iterdir()) == []


def test_a_column_without_a_meaning_is_named_in_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "d.csv"
    path.write_text("timestamp,x,y,camera_model\n0,1,2,fisheye\n")
    assert len(read_detections(path).scene("d").frames) == 1
    assert f"{path}: columns without a meaning here, not read: camera_model" in caplog.text


EGO_CSV = """\
timestamp,coordinates,x,y,odometry_x,odometry_y,odometry_yaw,odometry_dt,gps_x,gps_y,gps_z
0.0,ego,10.2,3.1,,,,,500.1,20.0,
0.1,ego,9.2,3.1,1.0,0.1,0.02,0.1,,,
0.1,ego,4.2,3.1,,,,,,,
0.2,ego,,,,,,,502.0,20.3,7.5
"""


def test_the_vehicles_own_measurements_come_with_its_frames(tmp_path: Path) -> None:
    first, second, third = read_detections(write(tmp_path, ".csv", EGO_CSV)).scene("drive").frames
    assert [frame.world_T_ego for frame in (first, second, third)] == [None] * 3
    assert first.ego.odometry is None
    assert first.ego.gps.position.tolist() == [500.1, 20.0]
    assert second.ego.gps is None
    assert second.ego.odometry.dt == 0.1
    assert second.ego.odometry.before_T_now[:2, 2].tolist() == [1.0, 0.1]
    assert second.ego.odometry.before_T_now[1, 0] == pytest.approx(np.sin(0.02))
    assert third.ego.gps.position.tolist() == [502.0, 20.3, 7.5]


@pytest.mark.parametrize(
    ("columns", "row", "message"),
    [
        ("gps_x", "1.0", "gps_y: expected a number, since gps_x is given"),
        ("odometry_x,odometry_dt", "1.0,0.1", "odometry_y: expected a number, since odometry_x is given"),
        ("odometry_x,odometry_y,odometry_yaw,odometry_dt", "1,0,0,0", "odometry_dt: expected seconds > 0, got 0"),
        ("gps_x,gps_y", "far,0", "gps_x: expected a number, got 'far'"),
    ],
)
def test_own_measurements_that_make_no_sense(tmp_path: Path, columns: str, row: str, message: str) -> None:
    path = write(tmp_path, ".csv", f"timestamp,x,y,{columns}\n0.0,1.0,2.0,{row}\n")
    with pytest.raises(InputError, match=f"line 2: {message}"):
        read_detections(path)


def test_short_names_of_sides_and_no_guesses_at_others(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    path.write_text("timestamp,x,y,len,wid,hgt,vx_m,vy_m,dx,idx\n0,1,2,4,2,1.5,3,0,9,7\n")
    (frame,) = read_detections(path).scene("detections").frames
    np.testing.assert_array_equal(frame.detections.boxes.size, [[4, 2, 1.5]])
    np.testing.assert_array_equal(frame.detections.boxes.velocity, [[3, 0]])
    path.write_text("timestamp,x,y,coastin,cov_x\n0,1,2,4,2\n")  # columns of tracks are no guess for detections
    assert survey_table(path).raw.found.unread == ("coastin", "cov_x")


def test_exchanged_sides_keep_the_units_of_their_names(tmp_path: Path) -> None:
    path = tmp_path / "detections.csv"
    path.write_text("timestamp,x,y,length_cm,width_cm\n0,1,2,190,450\n")
    how = TableImport(columns={"length": "width_cm", "width": "length_cm"})
    (frame,) = read_detections(path, how).scene("detections").frames
    np.testing.assert_allclose(frame.detections.boxes.size[0, :2], [4.5, 1.9])
