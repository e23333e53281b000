"""A short drive as a recording of ROS 2, written by the writers of other libraries: mcap-ros2-support, rosbags, mcap.

The vehicle starts at (100, 50) of the frame `map` and drives north with 10 m/s; its LiDAR is 1 m ahead of `base_link`
and looks to the left. A car drives 20 m ahead with 8 m/s, a pedestrian stands at (95, 80); both are 1 m above ground.
Definitions of messages are those of their packages, with the constants and comments that recordings have.
"""

import math
from functools import cache

import numpy as np

START, STEP, MOMENTS = 1_700_000_000_000_000_000, 100_000_000, 20  # ns
LIDAR = "/perception/lidar/objects"
MSGS = {
    "vision_msgs/msg/ObjectHypothesis": "# class\nstring class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
        "string id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
    "autoware_perception_msgs/msg/ObjectClassification": (
        "uint8 UNKNOWN = 0\nuint8 CAR = 1\nuint8 HAZARD = 9 # can cause danger\nuint8 label\nfloat32 probability\n"
    ),
    "autoware_perception_msgs/msg/Shape": (
        "uint8 BOUNDING_BOX=0\nuint8 CYLINDER=1\nuint8 POLYGON=2\nuint8 type\ngeometry_msgs/Polygon footprint\n"
        "geometry_msgs/Vector3 dimensions\n"
    ),
    "autoware_perception_msgs/msg/DetectedObjectKinematics": (
        "uint8 UNAVAILABLE=0\nuint8 SIGN_UNKNOWN=1\nuint8 AVAILABLE=2\n"
        "geometry_msgs/PoseWithCovariance pose_with_covariance\nbool has_position_covariance\n"
        "uint8 orientation_availability\ngeometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "bool has_twist\nbool has_twist_covariance\n"
    ),
    "autoware_perception_msgs/msg/DetectedObject": (
        "float32 existence_probability\nautoware_perception_msgs/ObjectClassification[] classification\n"
        "autoware_perception_msgs/DetectedObjectKinematics kinematics\nautoware_perception_msgs/Shape shape\n"
    ),
    "autoware_perception_msgs/msg/DetectedObjects": (
        "std_msgs/Header header\nautoware_perception_msgs/DetectedObject[] objects\n"
    ),
    "autoware_perception_msgs/msg/TrackedObjectKinematics": (
        "uint8 UNAVAILABLE=0\nuint8 SIGN_UNKNOWN=1\nuint8 AVAILABLE=2\n"
        "geometry_msgs/PoseWithCovariance pose_with_covariance\n"
        "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
        "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nuint8 orientation_availability\n"
        "bool is_stationary\n"
    ),
    "autoware_perception_msgs/msg/TrackedObject": (
        "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
        "autoware_perception_msgs/ObjectClassification[] classification\n"
        "autoware_perception_msgs/TrackedObjectKinematics kinematics\nautoware_perception_msgs/Shape shape\n"
    ),
    "autoware_perception_msgs/msg/TrackedObjects": (
        "std_msgs/Header header\nautoware_perception_msgs/TrackedObject[] objects\n"
    ),
}
DETECTED, ARRAY = "autoware_perception_msgs/msg/DetectedObjects", "vision_msgs/msg/Detection3DArray"
TF, ODOMETRY = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"


@cache
def typestore():
    """The types of ROS 2 Humble, with those above."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    found = {}
    for name, text in MSGS.items():
        found.update(get_types_from_msg(text, name))
    store.register(found)
    return store


def header(k, frame):
    seconds, nanoseconds = divmod(START + k * STEP, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def vector(x, y, z):
    return {"x": float(x), "y": float(y), "z": float(z)}


def turn(yaw):
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def vehicle(k):
    """Place of base_link in the map."""
    return np.array([100.0, 50.0 + 10.0 * k * STEP / 1e9, 0.0])


def objects(k):
    """Label, place in the map, velocity in the map, size."""
    t = k * STEP / 1e9
    return [
        ("car", np.array([100.0, 70.0 + 8.0 * t, 1.0]), np.array([0.0, 8.0, 0.0]), (4.5, 1.9, 1.6)),
        ("pedestrian", np.array([95.0, 80.0, 1.0]), np.zeros(3), (0.6, 0.6, 1.8)),
    ]


def in_lidar(k, place):
    """Coordinates in the LiDAR's frame: base_link faces north, the LiDAR 1 m ahead of it faces west."""
    offset = place - vehicle(k)
    ahead, left = offset[1] - 1.0, -offset[0]  # in base_link's axes, from the LiDAR
    return np.array([left, -ahead, offset[2]])


HEADING = {"car": -math.pi / 2, "pedestrian": 0.0}  # in the LiDAR's frame: north is to its right


def detected_objects(k, covariance=0.0):
    """DetectedObjects in the LiDAR's frame; the pedestrian has neither heading nor velocity."""
    labels = {"car": 1, "pedestrian": 7}
    spread = [0.0] * 36
    spread[0], spread[7] = covariance, covariance / 4
    rows = []
    for label, place, velocity, size in objects(k):
        moving = label == "car"
        rows.append(
            {
                "existence_probability": 0.75,
                "classification": [{"label": 2, "probability": 0.2}, {"label": labels[label], "probability": 0.8}],
                "kinematics": {
                    "pose_with_covariance": {
                        "pose": {"position": vector(*in_lidar(k, place)), "orientation": turn(HEADING[label])},
                        "covariance": spread,
                    },
                    "has_position_covariance": covariance > 0,
                    "orientation_availability": 2 if moving else 0,
                    "twist_with_covariance": {
                        "twist": {"linear": vector(np.hypot(*velocity[:2]), 0, 0), "angular": vector(0, 0, 0)},
                        "covariance": [0.0] * 36,
                    },
                    "has_twist": moving,
                    "has_twist_covariance": False,
                },
                "shape": {"type": 0, "footprint": {"points": []}, "dimensions": vector(*size)},
            }
        )
    return {"header": header(k, "lidar"), "objects": rows}


def detection_array(k, frame="map"):
    """Detection3DArray in the frame of the map."""
    rows = []
    for label, place, _, size in objects(k):
        pose = {"position": vector(*place), "orientation": turn(math.pi / 2)}
        results = [
            {"hypothesis": {"class_id": name, "score": score}, "pose": {"pose": pose, "covariance": [0.0] * 36}}
            for name, score in ((label.upper(), 0.9), ("OTHER", 0.05))
        ]
        box = {"center": pose, "size": vector(*size)}
        rows.append({"header": header(k, frame), "results": results, "bbox": box, "id": ""})
    return {"header": header(k, frame), "detections": rows}


def map_to_base(k):
    return {
        "header": header(k, "map"),
        "child_frame_id": "base_link",
        "transform": {"translation": vector(*vehicle(k)), "rotation": turn(math.pi / 2)},
    }


BASE_TO_LIDAR = {
    "header": header(0, "base_link"),
    "child_frame_id": "lidar",
    "transform": {"translation": vector(1, 0, 0), "rotation": turn(math.pi / 2)},
}


def odometry(k):
    still = {"linear": vector(10, 0, 0), "angular": vector(0, 0, 0)}
    pose = {"position": vector(*vehicle(k)), "orientation": turn(math.pi / 2)}
    return {
        "header": header(k, "map"),
        "child_frame_id": "base_link",
        "pose": {"pose": pose, "covariance": [0.0] * 36},
        "twist": {"twist": still, "covariance": [0.0] * 36},
    }


def drive(content=detected_objects, type_=DETECTED, topic=LIDAR, with_tf=True):
    """The messages of a drive: topic, type, content, log time."""
    found = [("/tf_static", TF, {"transforms": [BASE_TO_LIDAR]}, START)] if with_tf else []
    for k in range(MOMENTS):
        time = START + k * STEP
        if with_tf:
            found.append(("/tf", TF, {"transforms": [map_to_base(k)]}, time))
        found.append((topic, type_, content(k), time + 30_000_000))  # detectors take their time
    return found


def write_mcap(path, messages, plain=False):
    """A file of MCAP by mcap-ros2-support; plain: neither compressed nor with check sums."""
    from mcap.writer import CompressionType
    from mcap_ros2.writer import Writer

    store, schemas = typestore(), {}
    with path.open("wb") as file:
        writer = Writer(
            file, compression=CompressionType.NONE if plain else CompressionType.ZSTD, enable_crcs=not plain
        )
        for topic, type_, content, time in messages:
            if type_ not in schemas:
                schemas[type_] = writer.register_msgdef(type_, store.generate_msgdef(type_, ros_version=2)[0])
            writer.write_message(topic, schemas[type_], content, log_time=time, publish_time=time)
        writer.finish()
    return path


def write_bag(path, messages, storage="sqlite3"):
    """A bag folder by rosbags."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    store, connections = typestore(), {}
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(path, version=8, storage_plugin=plugin) as writer:
        for topic, type_, content, time in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_, typestore=store)
            writer.write(connections[topic], time, store.serialize_cdr(_typed(store, type_, content), type_))
    return path


def _typed(store, type_, content):
    """A dictionary as an instance of its type."""
    fields = {name: _value(store, kind, content[name]) for name, kind in store.fielddefs[type_][1]}
    return store.types[type_](**fields)


def _value(store, kind, value):
    node, argument = kind
    if node.name == "NAME":
        return _typed(store, argument, value)
    if node.name in ("ARRAY", "SEQUENCE"):
        inner = argument[0]
        if inner[0].name == "BASE" and inner[1][0] != "string":
            return np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.array(value, dtype=inner[1][0])
        return [_value(store, inner, each) for each in value]
    return value
