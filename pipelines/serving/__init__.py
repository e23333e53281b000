"""Live tracking as a service: detections in and tracks out, as newline-delimited JSON.

    line -> message -> numbering -> reordering -> tracker -> answer

`StreamTracker` answers lines; `serve_pipe` takes them from standard input, `SocketServer` from a TCP or Unix socket;
`StateKeeper` keeps the state in a file. `ros2.Ros2Node` gives frames of ROS 2's messages to the same stream, over a
`Ros2Network`: DDS without ROS, or rclpy.
"""

from pipelines.serving.messages import StreamClient
from pipelines.serving.server import SocketServer, StopRequest, serve_pipe
from pipelines.serving.settings import Address, LogLimitFilter, StreamSettings, parse_address
from pipelines.serving.state import StateKeeper
from pipelines.serving.stream import StreamTracker

__all__ = [
    "Address",
    "LogLimitFilter",
    "SocketServer",
    "StateKeeper",
    "StopRequest",
    "StreamClient",
    "StreamSettings",
    "StreamTracker",
    "parse_address",
    "serve_pipe",
]
