"""What a service does with time, and how much it takes in."""

from __future__ import annotations

import math
from dataclasses import dataclass

from saga_fg.settings import require_between, require_positive, setting


@dataclass(frozen=True)
class StreamSettings:
    """Limits of a stream; times in seconds on the frames' own clock, if nothing else is said."""

    reorder: float = setting(0.0, "s a frame is held back, so that frames of several sensors go in in order of time")
    max_held: int = setting(256, "frames held back at most; beyond, the oldest goes in")
    max_jump: float = setting(10.0, "s a clock may jump before a second frame has to agree with it")
    max_sensors: int = setting(1000, "sensors at most that number their messages")
    max_detections: int = setting(5000, "detections of a frame at most")
    max_message: int = setting(4 * 2**20, "bytes of a message at most")
    max_queue: int = setting(64, "messages of all clients that wait; beyond, reading pauses")
    client_timeout: float = setting(10.0, "s (wall clock) a client may leave its answers unread before it is let go")

    def __post_init__(self) -> None:
        require_between(self, 0.0, math.inf, "reorder")
        require_positive(self, "max_held", "max_jump", "max_sensors", "max_detections", "max_message", "max_queue")
        require_positive(self, "client_timeout")
