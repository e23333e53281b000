"""Recordings of ROS 2, written by other libraries, as scenes; and what is wrong with broken ones."""

import logging
import sqlite3
from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mcap_ros2")
pytest.importorskip("rosbags")

from data_tools.datasets.mcap.dataset import McapRecording, RecordingOptions
from data_tools.datasets.mcap.ros2_types import definition, nanoseconds, plain_type
from saga_fg import InputError
from saga_fg.numerics.geometry import yaw_transform
from tests.data_tools import mcap_example as example
from tests.data_tools.mcap_example import ARRAY, DETECTED, LIDAR, ODOMETRY, START, STEP, TF


def read(path, **options):
    recording = McapRecording(path, RecordingOptions(**options))
    return recording.scene(recording.scenes[0])


def in_world(frame):
    boxes = frame.detections.boxes
    return boxes if frame.coordinates == "world" else boxes.transformed(frame.world_T_ego)


def is_the_drive(scene):
    assert len(scene) == len(scene.frames) == example.MOMENTS
    assert scene.tokens == tuple(str(START + k * STEP) for k in range(example.MOMENTS))
    for k, frame in enumerate(scene.frames):
        assert frame.world_T_ego == pytest.approx(yaw_transform(*example.vehicle(k), yaw=np.pi / 2), abs=1e-9)
        boxes, truth = in_world(frame), example.objects(k)
        assert boxes.label.tolist() == ["car", "pedestrian"]
        assert boxes.position == pytest.approx(np.array([place for _, place, _, _ in truth]))
        assert boxes.size == pytest.approx(np.array([size for *_, size in truth]))
        assert boxes.yaw[0] == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("form", ["mcap", "mcap folder", "sqlite folder"])
def test_autoware_objects_of_a_file_and_of_bag_folders(tmp_path, form):
    if form == "mcap":
        path = example.write_mcap(tmp_path / "drive.mcap", example.drive())
    else:
        path = example.write_bag(tmp_path / "drive", example.drive(), "mcap" if "mcap" in form else "sqlite3")
    scene = read(path)
    is_the_drive(scene)
    assert scene.name == "drive"
    assert scene.sensors == (LIDAR.lstrip("/"),)
    frame = scene.frames[5]
    assert frame.detections.score == pytest.approx([0.75, 0.75])
    assert in_world(frame).velocity[0] == pytest.approx([0.0, 8.0], abs=1e-9)
    assert np.isnan(frame.detections.boxes.velocity[1]).all()
    assert np.isnan(frame.detections.boxes.yaw[1])
    assert np.isnan(frame.detections.position_covariance).all()


def test_a_bag_in_sqlite_without_definitions_is_read_by_the_known_ones(tmp_path):
    path = example.write_bag(tmp_path / "drive", example.drive())
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    is_the_drive(read(path))


def test_detection_arrays_with_names_of_their_own(tmp_path):
    messages = example.drive(example.detection_array, ARRAY, "/objects")
    path = example.write_mcap(tmp_path / "drive.mcap", messages)
    scene = read(path, classes={"CAR": "car", "PEDESTRIAN": "pedestrian"}, topics={"fused": "/objects"})
    is_the_drive(scene)
    assert scene.sensors == ("fused",)
    assert scene.frames[0].coordinates == "world"
    without = read(path, classes={"PEDESTRIAN": ""})
    assert [frame.detections.boxes.label.tolist() for frame in without.frames] == [["CAR"]] * example.MOMENTS
    assert scene.frames[0].detections.score == pytest.approx([0.9, 0.9])


def test_the_pose_may_come_from_odometry(tmp_path):
    messages = [("/tf_static", TF, {"transforms": [example.BASE_TO_LIDAR]}, START)]
    messages += [m for m in example.drive() if m[1] == DETECTED]
    messages += [("/odom", ODOMETRY, example.odometry(k), START + k * STEP) for k in range(example.MOMENTS)]
    is_the_drive(read(example.write_mcap(tmp_path / "one.mcap", messages)))
    more = [("/other", ODOMETRY, example.odometry(0), START)]
    path = example.write_mcap(tmp_path / "two.mcap", messages + more)
    with pytest.raises(InputError, match="expected --odometry with one of /odom, /other"):
        read(path)
    is_the_drive(read(path, odometry="/odom"))
    with pytest.raises(InputError, match="--odometry: unknown topic '/od'"):
        read(path, odometry="/od")


def test_reported_covariances_turn_with_the_boxes(tmp_path):
    messages = example.drive(lambda k: example.detected_objects(k, covariance=0.4))
    frame = read(example.write_mcap(tmp_path / "drive.mcap", messages)).frames[3]
    assert frame.detections.position_covariance[0] == pytest.approx(np.diag([0.1, 0.4]))  # the LiDAR looks to the left


def test_poses_between_those_that_are_recorded(tmp_path):
    def late(k):
        content = example.detected_objects(k)
        content["header"]["stamp"]["nanosec"] += STEP // 2
        return content

    scene = read(example.write_mcap(tmp_path / "drive.mcap", example.drive(late)))
    between = (example.vehicle(4) + example.vehicle(5)) / 2
    assert scene.frames[4].world_T_ego[:3, 3] == pytest.approx(between)


def test_messages_without_a_pose_are_left_out_and_said(tmp_path, caplog):
    messages = [m for m in example.drive() if m[1] != TF or m[0] == "/tf_static" or m[3] > START + 5 * STEP]
    path = example.write_mcap(tmp_path / "drive.mcap", messages)
    with caplog.at_level(logging.WARNING):
        scene = read(path)
    assert scene.tokens[0] == str(START + 5 * STEP)  # a tenth of a second before the first pose
    assert "left out 5 of 20 messages" in caplog.text


def test_without_transforms_the_frame_of_the_messages_stands_still(tmp_path, caplog):
    path = example.write_mcap(tmp_path / "drive.mcap", example.drive(with_tf=False))
    with caplog.at_level(logging.WARNING):
        scene = read(path)
    assert "frame lidar is taken for one that stands still" in caplog.text
    assert {frame.coordinates for frame in scene.frames} == {"world"}


def test_a_message_without_a_stamp_has_the_time_of_the_log(tmp_path):
    def unstamped(k):
        content = example.detection_array(k)
        content["header"]["stamp"] = {"sec": 0, "nanosec": 0}
        return content

    messages = example.drive(unstamped, ARRAY, "/objects", with_tf=False)
    assert read(example.write_mcap(tmp_path / "drive.mcap", messages)).tokens[0] == str(START + 30_000_000)


def test_two_topics_are_two_sensors(tmp_path):
    both = example.drive() + [
        ("/radar", ARRAY, example.detection_array(k), START + k * STEP) for k in range(example.MOMENTS)
    ]
    path = example.write_mcap(tmp_path / "drive.mcap", both)
    with pytest.raises(InputError) as raised:
        read(path)
    assert "expected --topic with one or several of the topics that hold objects" in str(raised.value)
    assert "/radar (vision_msgs/Detection3DArray, 20 messages)" in str(raised.value)
    scene = read(path, topics={"lidar": LIDAR, "radar": "/radar"})
    assert scene.sensors == ("lidar", "radar")
    assert len(scene.frames) == 2 * len(scene)


def test_shapes_of_autoware(tmp_path):
    def shaped(k):
        content = example.detected_objects(k)
        content["objects"][0]["shape"] = {"type": 1, "footprint": {"points": []}, "dimensions": example.vector(2, 0, 3)}
        corners = [example.vector(x, y, 0) for x, y in ((-1, 0), (2, 0), (1, 1.5))]
        shape = {"type": 2, "footprint": {"points": corners}, "dimensions": example.vector(0, 0, 1)}
        content["objects"][1]["shape"] = shape
        content["objects"][1]["classification"] = []
        return content

    boxes = read(example.write_mcap(tmp_path / "drive.mcap", example.drive(shaped))).frames[0].detections.boxes
    assert boxes.size == pytest.approx(np.array([[2, 2, 3], [3, 1.5, 1]]))
    assert boxes.label.tolist() == ["car", "unknown"]


def broken(field, value):
    """A drive whose third message has another value at a path of keys and indices."""

    def content(k):
        message = example.detected_objects(k, covariance=0.4)
        if k == 2:
            place = message
            for key in field[:-1]:
                place = place[key]
            place[field[-1]] = value
        return message

    return example.drive(content)


POSE = ("objects", 1, "kinematics", "pose_with_covariance")


def test_wrong_values_are_named_by_file_topic_message_and_field(tmp_path, subtests):
    for field, value, message in [
        ((*POSE, "pose", "position", "y"), np.nan, r"objects\[1\]\.kinematics\.\S*\.position: expected finite numbers"),
        ((*POSE, "pose", "position", "y"), 1e12, r"objects\[1\]\.kinematics\.\S*\.position: expected finite numbers"),
        ((*POSE, "pose", "orientation", "w"), 3.0, r"orientation: expected a unit quaternion, got norm 3"),
        ((*POSE, "covariance"), [-1.0] * 36, r"objects\[1\]\S*covariance: expected a positive definite covariance"),
        (("objects", 0, "shape", "dimensions", "x"), -2.0, r"objects\[0\]\.shape\.dimensions: expected sizes >= 0"),
        (("objects", 0, "existence_probability"), np.inf, r"objects\[0\]\.existence_probability: expected finite"),
    ]:
        with subtests.test(message):
            path = example.write_mcap(tmp_path / "drive.mcap", broken(field, value))
            with pytest.raises(InputError, match=rf"drive\.mcap: {LIDAR}: message 3: .*{message}"):
                read(path)


def test_transforms_that_are_none_are_named(tmp_path):
    path = example.write_mcap(tmp_path / "drive.mcap", broken(("header", "frame_id"), "lidat"))
    with pytest.raises(InputError, match=rf"{LIDAR}: message 3: unknown frame 'lidat'; did you mean 'lidar'"):
        read(path)
    messages = deepcopy(example.drive())
    messages[5][2]["transforms"][0]["transform"]["rotation"]["w"] = 5.0
    with pytest.raises(InputError, match=r"/tf: message 3: transform of base_link: rotation\[0\]: expected a unit"):
        read(example.write_mcap(tmp_path / "drive.mcap", messages))
    back = {**example.map_to_base(0), "header": example.header(0, "base_link"), "child_frame_id": "map"}
    messages = [*example.drive(), ("/tf", TF, {"transforms": [back]}, START)]
    with pytest.raises(InputError, match="expected a tree of frames, got the circle"):
        read(example.write_mcap(tmp_path / "drive.mcap", messages))


def test_wrong_options(tmp_path, subtests):
    for options, message in [
        ({"world": "moon"}, "--world: unknown frame 'moon', expected one of: base_link, lidar, map"),
        ({"ego": "base"}, "--ego: unknown frame 'base'"),
        ({"topics": {"a": "/perception/lidar/object"}}, "--topic: unknown topic '/perception/lidar/object'; did you"),
        ({"topics": {"a": "/tf"}}, "--topic /tf: tf2_msgs/TFMessage: expected a topic that holds objects: /perc"),
    ]:
        with subtests.test(message):
            path = example.write_mcap(tmp_path / "drive.mcap", example.drive())
            with pytest.raises(InputError, match=message):
                read(path, **options)


def test_files_that_are_no_recordings(tmp_path):
    for name, content, message in (
        ("none.mcap", None, "there is no such file"),
        ("drive.bag", b"#ROSBAG V2.0", "expected a file .mcap or .db3, or a bag folder"),
        ("text.mcap", b"hello", "not readable"),
        ("empty.mcap", b"", "not readable"),
        ("text.db3", b"hello" * 100, "expected a bag of ROS 2 in SQLite"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}: .*{message}"):
            McapRecording(tmp_path / name)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a.mcap.zstd").write_bytes(b"")
    with pytest.raises(InputError, match=r"files \.mcap or \.db3, there are none; decompress"):
        McapRecording(tmp_path / "folder")


def test_recordings_that_are_cut_off_or_have_other_topics_are_refused(tmp_path):
    path = example.write_mcap(tmp_path / "drive.mcap", example.drive())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"drive\.mcap: not readable: .*; the file may be cut off: mcap recover"):
        read(path)
    messages = [m for m in example.drive() if m[1] == TF]
    path = example.write_mcap(tmp_path / "drive.mcap", messages)
    with pytest.raises(InputError, match=r"types that do: autoware_perception_msgs/DetectedObjects.*there are /tf"):
        McapRecording(path)


HOSTILE = {
    "a view that never ends": """DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE
        n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)
        SELECT id, 1 AS topic_id, 0 AS timestamp, x'' AS data FROM n""",
    "topics as a view": "ALTER TABLE topics RENAME TO others; CREATE VIEW topics AS SELECT * FROM others",
    "a virtual table": "DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
    "a view called a table": """ALTER TABLE messages RENAME TO others;
        CREATE VIEW messages AS SELECT * FROM others; PRAGMA writable_schema = ON;
        UPDATE sqlite_master SET type = 'table' WHERE name = 'messages'""",
    "no tables": "DROP TABLE messages; DROP TABLE topics",
}


def test_a_bag_is_read_from_plain_tables_alone(tmp_path, subtests):
    for number, (name, statements) in enumerate(HOSTILE.items()):
        path = example.write_bag(tmp_path / f"drive{number}", example.drive())
        file = next(path.glob("*.db3"))
        with sqlite3.connect(file) as database:
            database.execute("PRAGMA foreign_keys = OFF")
            database.executescript(statements)
        database.close()
        with subtests.test(name), pytest.raises(InputError, match=rf"{file.name}: expected a bag of ROS 2 in SQLite"):
            read(path)


def test_times_of_a_bag_that_are_none_or_beyond_64_bits_are_named(tmp_path):
    far = SimpleNamespace(sec=2**62, nanosec=0)
    with pytest.raises(InputError, match=r"time: expected nanoseconds within 64 bits"):
        nanoseconds(far)
    assert nanoseconds(SimpleNamespace(sec=-1, nanosec=1)) == 1 - 10**9
    path = example.write_bag(tmp_path / "drive", example.drive())
    file = next(path.glob("*.db3"))
    for time in ("1e300", "'noon'"):
        with sqlite3.connect(file) as database:
            database.execute(f"UPDATE messages SET timestamp = {time}")
        database.close()
        with pytest.raises(InputError, match=rf"{file.name}.*timestamp: expected whole nanoseconds, got"):
            read(path)


def test_a_bag_is_not_written_to(tmp_path):
    path = example.write_bag(tmp_path / "drive", example.drive())
    file = next(path.glob("*.db3"))
    before = file.read_bytes()
    file.chmod(0o444)
    is_the_drive(read(path))
    assert file.read_bytes() == before
    assert {each.name for each in path.iterdir()} == {file.name, "metadata.yaml"}


def test_definitions_hold_all_that_they_are_made_of():
    text = definition("autoware_auto_perception_msgs/msg/TrackedObjects")
    assert text == definition(plain_type("autoware_perception_msgs/TrackedObjects"))
    for part in ("MSG: unique_identifier_msgs/UUID", "uint8[16] uuid", "MSG: builtin_interfaces/Time"):
        assert part in text
    assert definition("other_msgs/String") is None
