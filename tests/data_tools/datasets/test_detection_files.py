"""Tables of detections. Tables of detections in every format."""

import csv
import inspect
import json
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import data_tools.datasets.detection_files
from data_tools.datasets.detection_files import TableImport, read_detections
from data_tools.datasets.detection_files.dataset import survey_table
from saga_fg import Dataset, InputError
from saga_fg.numerics.geometry import yaw_of
from saga_fg.tables.columns import COLUMNS
from tests.data_tools.datasets.drive_tables import NPZ, write


@pytest.mark.parametrize("suffix", [".csv", ".ndjson", ".jsonl", ".npz"])
def test_every_format_says_the_same(tmp_path, suffix):
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


def test_three_columns_are_enough_and_others_are_left_alone(tmp_path):
    content: dict[str, Any] = {
        ".csv": "timestamp,x,y,remark,frame\n7,1,2,,9\n",
        ".ndjson": '{"timestamp": 7, "x": 1, "y": 2}\n',
        ".npz": {"timestamp": [7], "x": [1], "y": [2]},
    }
    for suffix, table in content.items():
        (frame,) = read_detections(write(tmp_path, suffix, table)).scene("drive").frames
        (detection,) = frame.detections
        assert (frame.sensor, frame.coordinates) == ("sensor", "world")
        assert (detection.label, detection.position, detection.score) == ("object", (1.0, 2.0, 0.0), 1.0)


def test_the_examples_of_the_documentation(tmp_path):
    doc = inspect.getdoc(data_tools.datasets.detection_files) or ""
    examples = re.findall(r"(?:^    .*\n)+", doc, re.MULTILINE)
    table, csv_text, ndjson_text, npz_call = (inspect.cleandoc(text) for text in examples)
    for suffix, text in ((".csv", csv_text), (".ndjson", ndjson_text)):
        frames = read_detections(write(tmp_path, suffix, text)).scene("drive").frames
        assert [len(frame) for frame in frames][-1] == 0
        assert frames[0].detections[0].position == (10.2, 3.1, 0.0)
    arrays = eval(f"dict({npz_call.removeprefix('np.savez(').split(',', 1)[1]}")
    assert [len(f) for f in read_detections(write(tmp_path, ".npz", arrays)).scene("drive").frames] == [1, 0]
    for name in COLUMNS:
        assert re.search(rf"\b{name}\b", table) or name == "empty"


def test_poses_and_ego_coordinates(tmp_path):
    text = "timestamp,x,y,coordinates,ego_x,ego_y,ego_yaw\n0,1,1,ego,5,6,0.5\n1,1,1,ego,7,8,-0.5\n1,2,2,ego,7,8,-0.5\n"
    scene = read_detections(write(tmp_path, ".csv", text)).scene("drive")
    np.testing.assert_allclose(scene.world_T_ego[:, :3, 3], [[5, 6, 0], [7, 8, 0]])
    np.testing.assert_allclose(yaw_of(scene.world_T_ego[:, :3, :3]), [0.5, -0.5])
    assert [frame.coordinates for frame in scene.frames] == ["ego", "ego"]
    np.testing.assert_array_equal(scene.frames[1].world_T_ego, scene.world_T_ego[1])


def test_empty_frames_alone_and_scenes_that_are_interleaved(tmp_path):
    scene = read_detections(write(tmp_path, ".ndjson", '{"timestamp": 0}\n{"timestamp": 1}\n')).scene("drive")
    assert [len(frame) for frame in scene.frames] == [0, 0]
    text = "scene,timestamp,x,y\nb,5,1,1\na,0,2,2\nb,6,3,3\na,1,4,4\n"
    data = read_detections(write(tmp_path, ".csv", text))
    assert data.scenes == ("b", "a")
    assert data.scene("b").timestamps.tolist() == [5, 6]
    assert data.scene("a").frames[1].detections[0].position == (4.0, 4.0, 0.0)
    with pytest.raises(InputError, match="unknown scene 'c'"):
        data.scene("c")


numbers = st.floats(-1e6, 1e6)
sizes = st.none() | st.floats(1e-3, 1e3)
rows = st.tuples(st.integers(0, 5), st.sampled_from("ab"), st.none() | st.tuples(numbers, numbers, sizes))


@settings(max_examples=40)
@given(st.lists(rows, min_size=1, max_size=12))
def test_csv_and_ndjson_agree(tmp_path_factory, table):
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
    frames = [
        {
            "header": {"stamp": time},
            "sensor": sensor,
            "objects": [
                {"box": {"center": {"x": box[0], "y": box[1]}, "size": {"length": box[2]}}, "tags": ["a"], "parts": []}
                for t, s, box in table
                if (t, s) == (time, sensor) and box is not None
            ],
        }
        for time, sensor in sorted({(t, s) for t, s, _ in table})
    ]
    (folder / "t.ndjson").write_text("\n".join(map(json.dumps, frames)))
    one, *others = (read_detections(folder / f"t.{suffix}").scene("t").frames for suffix in ("csv", "jsonl", "ndjson"))
    assert [(f.timestamp, f.sensor) for f in one] == sorted({(t, s) for t, s, _ in table})
    assert sum(map(len, one)) == sum(box is not None for _, _, box in table)
    for other in others:
        assert [(f.timestamp, f.sensor) for f in one] == [(f.timestamp, f.sensor) for f in other]
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a.detections.boxes.position, b.detections.boxes.position)
            np.testing.assert_array_equal(a.detections.boxes.size, b.detections.boxes.size)


def test_nested_values_have_the_names_of_columns(tmp_path):
    """A vector has x, y and z, a quaternion in a list is none; a frame's vehicle and sensor are not the object."""
    frame = {
        "header": {"stamp": {"sec": 1, "nanosec": 250_000_000}},
        "ego": {"x": 5.0, "y": 6.0, "yaw": 0.0},
        "platform": {"position": [0, 0], "size": {"length": 9}, "velocity": [8, 8]},
        "objects": [
            {"class": "car", "pose": {"position": [1, 2, 3], "yaw": 0.5}, "velocity": [4, 5], "rotation": [1, 0, 0, 0]}
        ],
    }
    empty = frame | {"header": {"stamp": {"sec": 2, "nanosec": 0}}, "objects": []}
    lines = f"{json.dumps(frame)}\n{json.dumps(empty)}\n"
    scene = read_detections(write(tmp_path, ".ndjson", lines)).scene("drive")
    boxes = scene.frames[0].detections.boxes
    assert [(each.timestamp, len(each)) for each in scene.frames] == [(1.25, 1), (2.0, 0)]
    assert (boxes.label.tolist(), boxes.position.tolist(), boxes.yaw.tolist()) == (["car"], [[1, 2, 3]], [0.5])
    assert (boxes.velocity.tolist(), np.isnan(boxes.size).all()) == ([[4, 5]], True)
    assert scene.world_T_ego[0, :2, 3].tolist() == [5, 6]


def test_a_column_without_a_meaning_is_named_in_a_warning(tmp_path, caplog):
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


def test_leading_frames_without_objects_say_nothing_of_them(tmp_path, caplog):
    """A nested place of the vehicle is that of no object, in files of empty frames alone too."""
    path = tmp_path / "frames.ndjson"
    empty = '{"t": %d, "objects": [], "position": {"x": 1.0, "y": 2.0}, "drive": {"by": "me"}}\n'
    full = '{"t": 2, "objects": [{"x": 5, "y": 6, "size": [4, 2, 1.5]}], "position": {"x": 1.0, "y": 2.0}}\n'
    path.write_text(empty % 0 + empty % 1 + full)
    scene = read_detections(path).scene("frames")
    assert [len(frame.detections) for frame in scene.frames] == [0, 0, 1]
    assert "size is read as length, width, height; where width comes first: --columns" in caplog.text
    nothing = tmp_path / "nothing.ndjson"
    nothing.write_text('{"t": 0, "objects": [], "drive": {"by": "me"}}\n')
    assert [len(frame.detections) for frame in read_detections(nothing).scene("nothing").frames] == [0]
    flat = tmp_path / "flat.ndjson"
    flat.write_text('{"t": 0, "position": {"x": 1, "y": 2}, "tags": []}\n')
    assert read_detections(flat).scene("flat").frames[0].detections.boxes.position[0].tolist() == [1, 2, 0]


def test_the_vehicles_own_measurements_come_with_its_frames(tmp_path):
    first, second, third = read_detections(write(tmp_path, ".csv", EGO_CSV)).scene("drive").frames
    assert [frame.world_T_ego for frame in (first, second, third)] == [None] * 3
    assert first.ego.odometry is None
    assert first.ego.gps.position.tolist() == [500.1, 20.0]
    assert second.ego.gps is None
    assert second.ego.odometry.dt == 0.1
    assert second.ego.odometry.before_T_now[:2, 2].tolist() == [1.0, 0.1]
    assert second.ego.odometry.before_T_now[1, 0] == pytest.approx(np.sin(0.02))
    assert third.ego.gps.position.tolist() == [502.0, 20.3, 7.5]


def test_own_measurements_that_make_no_sense(tmp_path, subtests):
    for columns, row, message in [
        ("gps_x", "1.0", "gps_y: expected a number, since gps_x is given"),
        ("odometry_x,odometry_dt", "1.0,0.1", "odometry_y: expected a number, since odometry_x is given"),
        ("odometry_x,odometry_y,odometry_yaw,odometry_dt", "1,0,0,0", "odometry_dt: expected seconds > 0, got 0"),
        ("gps_x,gps_y", "far,0", "gps_x: expected a number, got 'far'"),
    ]:
        with subtests.test(message):
            path = write(tmp_path, ".csv", f"timestamp,x,y,{columns}\n0.0,1.0,2.0,{row}\n")
            with pytest.raises(InputError, match=f"line 2: {message}"):
                read_detections(path)


def test_sides_have_short_names_and_keep_their_units(tmp_path):
    path = tmp_path / "detections.csv"
    path.write_text("timestamp,x,y,len,wid,hgt,vx_m,vy_m,dx,idx\n0,1,2,4,2,1.5,3,0,9,7\n")
    (frame,) = read_detections(path).scene("detections").frames
    np.testing.assert_array_equal(frame.detections.boxes.size, [[4, 2, 1.5]])
    np.testing.assert_array_equal(frame.detections.boxes.velocity, [[3, 0]])
    path.write_text("timestamp,x,y,coastin,cov_x\n0,1,2,4,2\n")  # columns of tracks are no guess for detections
    assert survey_table(path).raw.found.unread == ("coastin", "cov_x")
    path = tmp_path / "detections.csv"
    path.write_text("timestamp,x,y,length_cm,width_cm\n0,1,2,190,450\n")
    how = TableImport(columns={"length": "width_cm", "width": "length_cm"})
    (frame,) = read_detections(path, how).scene("detections").frames
    np.testing.assert_allclose(frame.detections.boxes.size[0, :2], [4.5, 1.9])


# Tables of detections with faults: each is named with its record and field

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
    (
        HEAD + "\n28.11.2026 14:00:00,1,1,1,1,1,car\n",
        "line 4: timestamp: expected a number, or a date and time of ISO 8601 (2026-",
    ),
    (HEAD + "1,nan,1,1,1,1,car\n", "line 3: x: expected a finite number of metres, got nan"),
    (HEAD + "1,1,1e999,1,1,1,car\n", "line 3: y: expected a finite number, got inf"),
    (HEAD + "1,,1,1,1,1,car\n", "line 3: x: expected a finite number of metres, it is left out"),
    (HEAD + "1,1,1,1,0,1,car\n", "line 3: length: expected a positive number of metres, got 0"),
    (HEAD + "1,1,1,1,1,nan,car\n", "line 3: score: expected a finite number, got nan"),
    (HEAD + ",1,1,1,1,1,car\n", "line 3: timestamp: expected a finite number of seconds, it is left out"),
    (HEAD + "-1,1,1,1,1,1,car\n", "line 3: timestamp: expected rows in order of time, time runs backwards at -1.0 s"),
    ("timestamp,x,y,coordinates\n0,1,1,map\n", "line 2: coordinates: expected world, ego, sensor or camera, got 'map'"),
    ("timestamp,x,y,coordinates\n0,1,1,ego\n", "line 2: coordinates: ego needs the columns ego_x, ego_y and ego_yaw"),
    ("timestamp,x,y,ego_x\n0,1,1,3\n", "line 2: ego_y: expected a finite number, since ego_x is given, it is left out"),
    (HEAD + "1,1,1,1,1,1," + "c" * 200_000, "line 3: expected comma-separated values: field larger"),
    (HEAD + "1,1,1,1,1,1," + "c" * 1000, "line 3: label: expected a name of at most 256 characters, got 1000"),
    (HEAD + '1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 9 + '1,1,1,1,1,1,car"\n', f"line 3: {OPEN_QUOTE}"),
    (HEAD + '\n1,1,1,1,1,1,"car\n' + "1,1,1,1,1,1,car\n" * 10_000, f"line 4: {OPEN_QUOTE}"),
    ('"timestamp,x,y\n0,1,1\n', f"line 1: {OPEN_QUOTE}"),
    (HEAD + '1,1,1,1,1,1,"ca"r\n', "line 3: expected comma-separated values: ',' expected after '\"'"),
    ("timestamp,x,y,empty\n0,1,1,yes\n", "empty: expected an array of booleans, in NumPy archives only"),
]


def test_broken_csv(tmp_path, subtests):
    for text, message in BROKEN_CSV:
        with subtests.test(message):
            with pytest.raises(InputError, match=r"drive\.csv: " + re.escape(message)) as caught:
                read_detections(write(tmp_path, ".csv", text))
            assert "\n" not in str(caught.value)


def test_frame_with_two_poses_or_two_kinds_of_coordinates(tmp_path):
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
    (FIRST + '{"timestamp": 1, "x": 1, "y": 1, "label": 3}', "line 2: label: expected a name, got 3"),
    (FIRST + '{"timestamp": 1, "x": 1' + "0" * 400 + ', "y": 1}', "line 2: x: expected a finite number, got inf"),
    (FIRST + "[" * 100_000, "line 2: broken or truncated JSON"),
    ('{"t": 0, "a": [{"x": 1}], "b": [{"x": 1}]}', "line 1: expected one list of objects, got a, b"),
    ('{"t": {"sec": "1", "nanosec": 2}, "x": 1, "y": 2}', "line 1: timestamp (column 't'): expected a number, got"),
    ('{"t": 0, "a": [{"parts": [{"x": 1}]}]}', "line 1: parts: expected no list of objects in an object"),
    ('{"a": ' * 900 + "1" + "}" * 900, "expected a column 'timestamp' and a column 'x' and a column 'y'"),
    ("", "expected at least one row"),
]


def test_broken_ndjson(tmp_path, subtests):
    for text, message in BROKEN_NDJSON:
        with subtests.test(message), pytest.raises(InputError, match=r"drive\.ndjson: " + re.escape(message)):
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


def test_broken_npz(tmp_path, subtests):
    for changes, message in BROKEN_NPZ:
        with subtests.test(message), pytest.raises(InputError, match=r"drive\.npz: " + re.escape(message)):
            read_detections(write(tmp_path, ".npz", NPZ | changes))


def test_npz_that_is_none(tmp_path):
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


@pytest.mark.parametrize(
    ("line", "command"),
    [
        ("0 3 Car 0 0 -10 100 100 200 200 1.6 1.9 4.5 2.0 1.6 9.0 0.0 0.9", "kitti"),
        ("1,-1,794.2,47.5,71.2,174.8,0.7,-1,-1,-1", "motchallenge"),
        ('{"meta": {"use_camera": false}, "results": {', "nuscenes"),
    ],
)
def test_files_of_datasets_are_named(tmp_path, line, command):
    (tmp_path / "drive.txt").write_text(f"{line}\n")
    with pytest.raises(InputError, match=f"which `saga-fg track {command} --help` reads"):
        read_detections(tmp_path / "drive.txt")


def test_other_files(tmp_path):
    with pytest.raises(InputError, match=r"drive\.txt: expected a file name that ends in \.csv, \.ndjson"):
        read_detections(tmp_path / "drive.txt")
    for suffix in (".csv", ".ndjson", ".npz"):
        with pytest.raises(InputError, match=rf"drive\{suffix}: cannot be read: No such file"):
            read_detections(tmp_path / f"drive{suffix}")
    (tmp_path / "drive.csv").write_bytes(b"timestamp,x,y\n\xff\xfe")
    with pytest.raises(InputError, match=r"drive\.csv: expected text in UTF-8"):
        read_detections(tmp_path / "drive.csv")
