"""Limits of a service: what it does with time, how much it takes in, and how long it waits."""

from __future__ import annotations

from dataclasses import dataclass

from saga_fg.settings import (
    NonNegative,
    Positive,
    PositiveInt,
    PositiveOrInf,
    Settings,
    setting,
)

MB = 2**20


@dataclass(frozen=True)
class StreamSettings(Settings):
    """Limits of a stream and of its connections. `reorder` counts on the frames' clock, other times on the wall's."""

    reorder: NonNegative = setting(
        0.0, "s a frame is held back, so that frames of several sensors go in in order of time"
    )
    max_held: PositiveInt = setting(256, "frames held back at most; beyond, the oldest goes in")
    max_sensors: PositiveInt = setting(
        1000, "sensors whose frames are numbered at most; beyond, the one silent for longest loses its number"
    )
    max_seq_jump: PositiveInt = setting(
        1_000_000, "a `seq` further than this beyond the last one of its sensor is refused; the first may be any"
    )
    max_detections: PositiveInt = setting(
        500, "detections of a frame at most; one frame of so many takes up to 0.2 s, for which all clients wait"
    )
    max_message: PositiveInt = setting(4 * MB, "bytes of a message at most")
    max_failures: PositiveInt = setting(3, "internal errors of the tracker in a row that start a fresh tracker")
    max_clients: PositiveInt = setting(256, "connections at most, fewer where the process may not open as many files")
    max_unfinished: PositiveInt = setting(
        64 * MB, "bytes of unfinished and waiting lines of all clients; beyond, the client that holds most is closed"
    )
    max_outbox: PositiveInt = setting(
        8 * MB, "bytes of answers that wait for one client to read them; beyond, it is closed"
    )
    client_timeout: Positive = setting(
        0.5, "a client whose answers pile up and that reads nothing for this long is closed, s"
    )
    idle_timeout: PositiveOrInf = setting(3600.0, "a client without a message or an answer for this long is closed, s")
    stop_timeout: Positive = setting(
        5.0, "time to finish after SIGTERM or SIGINT; then the process ends all the same, s"
    )
