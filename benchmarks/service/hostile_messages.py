"""Messages that no sensor should send: one line each, with what makes it bad."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from pipelines.serving import StreamSettings

EPOCH = 1.7e9  # s; the good clients' clock starts here
JUMPS = (-EPOCH, -1e8, -1e4, -60.0, -11.0, 11.0, 60.0, 1e4, 1e8, 9e10)  # of a clock, s
SENSORS = ("front", "rear")  # of the good clients
NUMBERS = (1e300, -1e300, 1.7e308, 5e-324, 1e10, 1e9, -1e9, 1e6, 2.0**63)

MOST = StreamSettings().max_detections

Random = np.random.Generator
Values = dict[str, Any]


def hostile_line(rng: Random, now: float) -> bytes:
    """One line without its end; `now`: about what the good clients' clocks show, s."""
    kind = KINDS[rng.choice(len(KINDS), p=WEIGHTS)]
    return kind(rng, now)


def _frame(rng: Random, now: float, **values: Any) -> Values:
    detection = {"x": float(rng.uniform(-300, 300)), "y": float(rng.uniform(-300, 300)), "label": "car"}
    sensor = f"hostile-{rng.integers(20)}"
    return {"timestamp": now, "sensor": sensor, "detections": [detection]} | values


def _line(message: Any) -> bytes:
    return json.dumps(message).encode()


def _clock(rng: Random, now: float) -> bytes:
    """Two frames that agree on another time: the clock is set."""
    there = now + float(rng.choice(JUMPS))
    return _line(_frame(rng, there)) + b"\n" + _line(_frame(rng, there + 0.1))


def _glitch(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now + float(rng.choice(JUMPS))))


def _numbers(rng: Random, now: float) -> bytes:
    frame = _frame(rng, now)
    names = ["x", "y", "z", "length", "width", "height", "yaw", "vx", "vy", "score"]
    for name in rng.choice(names, rng.integers(1, 4), replace=False).tolist():
        frame["detections"][0][name] = float(rng.choice(NUMBERS))
    return _line(frame)


def _far(rng: Random, now: float) -> bytes:
    """Numbers that pass the door: far away, and fast."""
    frame = _frame(rng, now)
    frame["detections"][0] |= {
        "x": float(rng.uniform(-1e9, 1e9)),
        "vx": float(rng.uniform(-1e6, 1e6)),
        "vy": float(rng.uniform(-1e6, 1e6)),
    }
    return _line(frame)


def _range_rate(rng: Random, now: float) -> bytes:
    frame = _frame(rng, now, coordinates="ego", ego={"x": 0, "y": 0, "yaw": 0}, sensor="hostile-radar")
    frame["detections"][0] |= {"x": 20.0, "y": 5.0, "range_rate": float(rng.choice([1e10, -1e10, 1e300, 1e5, 200.0]))}
    return _line(frame)


def _bits(rng: Random, now: float) -> bytes:
    """Numbers of the whole range of float64."""
    frame = _frame(rng, now)
    (x, y) = struct.unpack("<2d", rng.bytes(16))
    frame["detections"][0] |= {"x": x, "y": y}
    return _line(frame)


def _types(rng: Random, now: float) -> bytes:
    odd: tuple[Any, ...] = (None, True, "1", [], {}, [[1]], {"a": 1}, -1, "x" * 1000)
    name = str(rng.choice(["timestamp", "sensor", "seq", "coordinates", "ego", "detections", "type", "unknown"]))
    return _line(_frame(rng, now, **{name: odd[rng.integers(len(odd))]}))


def _deep(rng: Random, now: float) -> bytes:
    opening = [b"[", b'{"a":', b'{"detections":['][rng.integers(3)]
    return opening * int(rng.integers(1000, 200_000))


def _integer(rng: Random, now: float) -> bytes:
    digits = b"9" * int(rng.integers(20, 6000))
    name = [b"timestamp", b"seq"][rng.integers(2)]
    return b'{"sensor": "hostile-0", "detections": [], "' + name + b'": ' + digits + b"}"


def _constant(rng: Random, now: float) -> bytes:
    return b'{"timestamp": ' + [b"NaN", b"-Infinity", b"1e400", b"-1e400"][rng.integers(4)] + b', "detections": []}'


def _bytes(rng: Random, now: float) -> bytes:
    return rng.bytes(int(rng.integers(1, 400))).replace(b"\n", b" ")


def _damaged(rng: Random, now: float) -> bytes:
    """A valid line with a few bytes changed."""
    line = bytearray(_line(_frame(rng, now)))
    for place in rng.integers(len(line), size=3).tolist():
        line[place] = int(rng.integers(11, 256))
    return bytes(line)


def _long(rng: Random, now: float) -> bytes:
    return b"[" + b"1," * int(rng.integers(2**19, 3 * 2**20))


def _crowd(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now, detections=[{"x": 0, "y": 0}] * (MOST + 1)))


def _heavy(rng: Random, now: float) -> bytes:
    """A valid frame of as many objects as one may have."""
    detections = [{"x": x, "y": y, "label": "car"} for x, y in rng.uniform(-300, 300, (MOST, 2)).round(2).tolist()]
    return _line(_frame(rng, now, sensor="hostile-heavy", detections=detections))


def _number(rng: Random, now: float) -> bytes:
    """The name of a good client's sensor, with a number that would make all its frames repeats."""
    number = int(rng.choice([2**63 - 1, 2**62, 10**12, 10**8, 2 * 10**6]))
    return _line(_frame(rng, now, sensor=str(rng.choice(SENSORS)), seq=number))


def _wrong_clock(rng: Random, now: float) -> bytes:
    """The name of a good client's sensor, whose clock is steadily an hour ahead."""
    return _line(_frame(rng, now + 3600.0, sensor=str(rng.choice(SENSORS))))


def _wrong_sensor(rng: Random, now: float) -> bytes:
    """A sensor of its own with a steadily wrong, a drifting or a jumping clock, whose frames are valid."""
    second = int(now - EPOCH)
    offset = {
        "ahead": 1.0,
        "behind": -3600.0,
        "drifting": 1e-2 * (now - EPOCH),
        "jumping": float(np.random.default_rng(second).uniform(-10.0, 10.0)),
    }
    name = str(rng.choice(list(offset)))
    return _line(_frame(rng, now + offset[name], sensor=name))


def _names(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now, sensor=f"hostile-{rng.integers(10**9)}"))


def _request(rng: Random, now: float) -> bytes:
    return _line({"type": str(rng.choice(["status", "reset", "stop", "subscribe", ""], p=[0.7, 0.05, 0.1, 0.05, 0.1]))})


def _valid(rng: Random, now: float) -> bytes:
    return _line(_frame(rng, now + float(rng.uniform(-2, 2))))


WEIGHTED: dict[Callable[[Random, float], bytes], float] = {
    **dict.fromkeys((_numbers, _far, _range_rate, _bits, _types, _damaged, _valid), 3.0),
    **dict.fromkeys((_integer, _constant, _bytes, _names, _request, _glitch, _number), 2.0),
    _wrong_sensor: 4.0,
    **dict.fromkeys((_deep, _clock, _wrong_clock), 0.5),
    **dict.fromkeys((_long, _crowd, _heavy), 0.1),
}
KINDS = tuple(WEIGHTED)
WEIGHTS = np.array(list(WEIGHTED.values())) / sum(WEIGHTED.values())
