"""Messages in CDR: as mcap-ros2-support writes and reads them."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")


from mcap.reader import make_reader
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

from data_tools.datasets.mcap.dataset import message_content
from data_tools.datasets.mcap.objects import OBJECT_TYPES, RESULTS, message_objects
from data_tools.datasets.mcap.recording import LoggedMessage, Topic
from data_tools.datasets.mcap.ros2_types import decoder, definition, encoded, known_types, ros_message
from data_tools.datasets.mcap.transforms import KEPT, TransformBuffer, TransformRecord, find_places
from saga_fg import Boxes, InputError, Tracks
from tests.data_tools import mcap_example as example

LABELS = ("car", "pedestrian", "a name of its own", "Straße")
TYPES = ("autoware_perception_msgs/TrackedObjects", "vision_msgs/Detection3DArray", "visualization_msgs/MarkerArray")


def tracks_of(labels, seed=0):
    rng, n = np.random.default_rng(seed), len(labels)
    position, size = rng.normal(0, 50, (n, 3)), rng.uniform(0.3, 9, (n, 3))
    boxes = Boxes.of(labels, position, size, rng.uniform(-3, 3, n), rng.normal(0, 9, (n, 2)))
    spread = np.tile(np.diag([0.4, 0.2]), (n, 1, 1))
    return Tracks(1.5, rng.integers(1, 2**40, n), boxes, rng.uniform(0, 1, n), spread, 2 * spread, np.zeros(n))


def read(type_, data):
    """What mcap-ros2-support reads by our definition."""
    schema = Schema(id=1, name=type_, encoding="ros2msg", data=definition(type_).encode())
    return DecoderFactory().decoder_for("cdr", schema)(data)


def written(type_, message):
    """What mcap-ros2-support writes by our definition."""
    file = io.BytesIO()
    writer = Writer(file)
    writer.write_message("/here", writer.register_msgdef(type_, definition(type_)), message, 1)
    writer.finish()
    ((_, _, found),) = make_reader(io.BytesIO(file.getvalue())).iter_messages()
    return found.data


@pytest.mark.parametrize("type_", TYPES)
@settings(deadline=None, max_examples=25)
@given(labels=st.lists(st.sampled_from(LABELS), max_size=9), frame=st.text("abc", max_size=9))
def test_results_are_the_bytes_that_another_library_writes(type_, labels, frame):
    tracks = tracks_of(labels)
    data = encoded(type_, RESULTS[type_](tracks, 10**18 + 7, frame, {"car": "CAR"}))
    assert written(type_, read(type_, data)) == data


@pytest.mark.parametrize("type_", TYPES[:2])
def test_results_are_read_back_as_they_were(type_):
    tracks = tracks_of(LABELS * 5)
    form = OBJECT_TYPES[type_]
    data = encoded(type_, form.message(tracks, 10**18 + 7, "map", {}))
    found = message_objects(form.rows(read(type_, data)), {})
    assert (found.stamp, found.frame) == (10**18 + 7, "map")
    assert found.id.tolist() == [str(id_) for id_ in tracks.id]
    boxes = found.detections.boxes
    np.testing.assert_allclose(boxes.position, tracks.boxes.position, atol=1e-12)
    np.testing.assert_allclose(boxes.yaw, tracks.boxes.yaw, atol=1e-12)
    np.testing.assert_allclose(found.detections.position_covariance, tracks.position_covariance)
    if type_ == TYPES[0]:
        np.testing.assert_allclose(boxes.velocity, tracks.boxes.velocity, atol=1e-12)


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize(
    ("type_", "content"),
    [
        (example.DETECTED, example.detected_objects(3, 0.5)),
        (example.ARRAY, example.detection_array(3)),
        (example.TF, {"transforms": [example.map_to_base(3), example.BASE_TO_LIDAR]}),
        (example.ODOMETRY, example.odometry(3)),
    ],
)
def test_messages_of_rosbags_in_both_byte_orders_are_read_equal(type_, content, little):
    plain, store = type_.replace("/msg/", "/"), example.typestore()
    message = example._typed(store, type_, content)
    data = bytes(store.serialize_cdr(message, type_, little_endian=little))
    assert data[1] == little
    topic = Topic("/here", plain, 1)
    found = message_content(LoggedMessage(topic, 1, 1, decoder(plain)(data)))
    expected = message_content(LoggedMessage(topic, 1, 1, message))
    if plain in OBJECT_TYPES:
        found, expected = message_objects(found, {}), message_objects(expected, {})
        assert (found.stamp, found.frame) == (expected.stamp, expected.frame)
        for name in ("position", "size", "yaw", "velocity", "label"):
            np.testing.assert_array_equal(
                getattr(found.detections.boxes, name), getattr(expected.detections.boxes, name)
            )
        np.testing.assert_array_equal(found.detections.position_covariance, expected.detections.position_covariance)
    else:
        assert found == expected


def test_fields_are_those_of_ros():
    for name in example.MSGS:
        assert known_types().fielddefs[name][1] == example.typestore().fielddefs[name][1]


def test_definitions_may_have_the_line_ends_of_another_system():
    message = ros_message("std_msgs/Header", ros_message("builtin_interfaces/Time", 1, 2), "map")
    data = encoded("std_msgs/Header", message)
    text = definition("std_msgs/Header").replace("\n", "\r\n")
    found = decoder("std_msgs/Header", text)(data)
    assert (found.stamp.sec, found.stamp.nanosec, found.frame_id) == (1, 2, "map")


@pytest.mark.parametrize("fixed", ["string[100000] x", "C[5000] x\n" + 80 * "=" + "\nMSG: a/C\nint32 y"])
def test_long_arrays_of_fixed_length_are_refused(fixed):
    with pytest.raises(InputError, match="x: expected a fixed length of at most 1000"):
        decoder("a/B", fixed)
    assert len(decoder("a/B", "float64[100000] x")(bytes(4 + 8 * 100000)).x) == 100000


def test_a_field_that_is_missing_is_named():
    with pytest.raises(TypeError, match="frame_id"):
        ros_message("std_msgs/Header", ros_message("builtin_interfaces/Time", 1, 2))
    none = encoded("tf2_msgs/TFMessage", ros_message("tf2_msgs/TFMessage", []))
    assert read("tf2_msgs/TFMessage", none).transforms == []


def transform(child, parent, seconds, x, static=False):
    return TransformRecord(parent, child, static, int(seconds * 1e9), (x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "/tf")


def place_of(buffer, frame, seconds, hold):
    time = int(seconds * 1e9)
    tree = buffer.tree([frame, "base_link"], time)
    return find_places(tree, "map", "base_link", [frame], np.array([time]), hold)


def test_a_buffer_has_the_transforms_that_a_recording_would_have():
    buffer = TransformBuffer()
    buffer.add(transform("lidar", "base_link", 0, 1.0, static=True))
    for k in [50 * (k // 50) + 49 - k % 50 for k in range(300)]:  # newer ones may come first
        buffer.add(transform("base_link", "map", 0.1 * k, 0.1 * k))
    places = place_of(buffer, "lidar", 25.05, hold=0.0)
    assert places.known.all()
    np.testing.assert_allclose(places.world_T_ego[0, :3, 3], [25.05, 0, 0], atol=1e-9)
    np.testing.assert_allclose(places.base_T_frame["lidar"][0, :3, 3], [1, 0, 0])
    assert not place_of(buffer, "lidar", 30.0, hold=0.05).known.any()
    assert place_of(buffer, "lidar", 29.95, hold=0.1).known.all()
    assert not place_of(buffer, "lidar", 29.9 - KEPT - 1, hold=0.1).known.any()  # no longer kept


def test_a_buffer_follows_a_clock_that_is_set_back_and_refuses_what_is_no_transform():
    buffer = TransformBuffer()
    with pytest.raises(InputError, match="frame 'mast': there are no transforms so far; --world mast"):
        place_of(buffer, "mast", 3.0, hold=0.0)
    buffer.add(transform("base_link", "map", 1000.0, 5.0))
    buffer.add(transform("base_link", "map", 3.0, 7.0))
    assert place_of(buffer, "base_link", 3.0, hold=0.0).known.all()
    for bad in ({"rotation": (0.0, 0.0, 0.0, 0.0)}, {"translation": (np.nan, 0.0, 0.0)}):
        with pytest.raises(InputError, match=r"/tf: transform of base_link: (rotation|translation)"):
            buffer.add(transform("base_link", "map", 4.0, 5.0)._replace(**bad))
    with pytest.raises(InputError, match="unknown frame 'radar'"):
        place_of(buffer, "radar", 3.0, hold=0.0)
    buffer.add(transform("radar", "mast", 3.0, 0.0))
    with pytest.raises(InputError, match="between the frames map and radar"):
        place_of(buffer, "radar", 3.0, hold=0.0)
