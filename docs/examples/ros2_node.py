"""A ROS 2 node: Autoware's DetectedObjects in, TrackedObjects out; needs rclpy, tf2_ros and autoware_perception_msgs.

python3 docs/examples/ros2_node.py --ros-args -r detections:=/perception/objects -r tracks:=/saga_fg/tracks
"""

import rclpy
from autoware_perception_msgs.msg import DetectedObjects, TrackedObjects
from rclpy.node import Node
from rclpy.time import Time
from rosidl_runtime_py import set_message_fields
from tf2_ros import Buffer, TransformException, TransformListener

from data_tools.datasets.mcap.objects import autoware_message, autoware_rows, message_objects, transform_matrix
from pipelines.config import load_config
from saga_fg import Frame, InputError


class TrackerNode(Node):
    """Tracks in the frame `map`; messages whose transform is unknown are left out."""

    def __init__(self) -> None:
        super().__init__("saga_fg")
        self.tracker = load_config("file").new_tracker("saga")
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.publisher = self.create_publisher(TrackedObjects, "tracks", 10)
        self.create_subscription(DetectedObjects, "detections", self.on_detections, 10)

    def on_detections(self, message: DetectedObjects) -> None:
        try:
            found = message_objects(autoware_rows(message), classes={})
            at = self.buffer.lookup_transform("map", found.frame, Time.from_msg(message.header.stamp))
            world_T_sensor = transform_matrix(at.transform)
            tracks = self.tracker.step(Frame(found.stamp / 1e9, "lidar", found.detections, world_T_sensor, "ego"))
        except (InputError, TransformException) as error:
            self.get_logger().warning(str(error))
            return
        result = TrackedObjects()
        set_message_fields(result, autoware_message(tracks, found.stamp, "map", names={}))
        self.publisher.publish(result)


def main() -> None:
    rclpy.init()
    rclpy.spin(TrackerNode())


if __name__ == "__main__":
    main()
