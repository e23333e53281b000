"""Live tracking as a service: detections in and tracks out, as newline-delimited JSON.

    line -> message -> clock -> reordering -> tracker -> answer

`StreamTracker` is the whole of it for one line; `serve_pipe` reads standard input, `SocketServer` a TCP or Unix socket.
"""

from pipelines.serving.address import Address, parse_address
from pipelines.serving.client import StreamClient
from pipelines.serving.pipe import serve_pipe
from pipelines.serving.settings import StreamSettings
from pipelines.serving.sockets import SocketServer
from pipelines.serving.stream import StreamTracker

__all__ = [
    "Address",
    "SocketServer",
    "StreamClient",
    "StreamSettings",
    "StreamTracker",
    "parse_address",
    "serve_pipe",
]
