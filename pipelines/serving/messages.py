"""The messages of a stream: one JSON object a line, UTF-8. docs/guides/stream.md has the tables.

in   frame      what a sensor detected at one time; `type` may be left out
     status     asks for counts and latencies
     subscribe  asks for the tracks of all frames, not just of those this client sends
     predict    asks for the tracks at times after the newest frame
     reset      forgets all tracks and the time: a new scene begins; with `sensor`, the number of that sensor alone
out  tracks     the answer to a frame
     held       a frame that waits for its turn; its answer follows
     late       a frame that came too late and was left out
     unconfirmed  a frame whose time jumps, left out unless the next frame agrees
     repeat     a frame that was judged before
     predictions  the answer to `predict`
     status, reset, subscribe   the answers to the other requests
     error      a message that could not be used, and why; nothing else happened

`StreamClient` is a small client, for Python programs and for `saga-fg status`.
"""

import json
import math
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from types import TracebackType
from typing import Any, NoReturn, Self, get_args

import numpy as np

from pipelines.serving.settings import Address, StreamSettings
from saga_fg import Boxes, Detections, Frame, InputError, PredictedTracks, Tracks
from saga_fg.numerics import FloatArray, yaw_transform
from saga_fg.types import Coordinates, PredictedMode, checked_horizons

MAX_HORIZON = 10.0  # furthest time of a prediction, s
MAX_HORIZONS = 20  # largest number of times of a prediction
LONGEST_NAME = 64  # characters of a label or a sensor: names are kept
REQUIRED = object()


@dataclass(frozen=True)
class Field:
    """A field of a message.

    expected  its values in words, for errors
    read      makes the value of what JSON has; raises `TypeError`, `ValueError` or `OverflowError` for other values
    default   of a field that is left out; null counts as left out, unless `null` is False
    """

    expected: str
    read: Callable[[Any], Any]
    default: Any = REQUIRED
    null: bool = True


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(number := float(value)):
        raise TypeError
    return number


def _checked(valid: Callable[[Any], bool]) -> Callable[[Any], Any]:
    """A reader that takes valid values as they are."""

    def read(value: Any) -> Any:
        if not valid(value):
            raise TypeError
        return value

    return read


def _horizons(value: Any) -> FloatArray:
    if not isinstance(value, list) or len(value) > MAX_HORIZONS:
        raise TypeError
    horizons = checked_horizons([_value("horizons", _NUMBER, each) for each in value])
    if horizons[-1] > MAX_HORIZON:
        raise InputError(f"horizons: expected at most {MAX_HORIZON:g} s, got {horizons[-1]:g}")
    return horizons


def _pose(value: Any) -> FloatArray:
    return yaw_transform(**_values("ego", value, EGO))


def _optional(default: float) -> Field:
    return Field(_NUMBER.expected, _number, default)


FRAMES = get_args(Coordinates)
POSITION, SIZE, VELOCITY = ("x", "y", "z"), ("length", "width", "height"), ("vx", "vy")
NUMBERS = (*POSITION, *SIZE, "yaw", *VELOCITY, "score")
_NUMBER = Field("a finite number", _number)
_NAME = Field(
    f"a name of 1 to {LONGEST_NAME} characters",
    _checked(lambda value: isinstance(value, str) and 0 < len(value) <= LONGEST_NAME),
    null=False,
)
DETECTION = {
    **dict.fromkeys((*NUMBERS, "range_rate"), _optional(math.nan)),
    "x": _NUMBER,
    "y": _NUMBER,
    "z": _optional(0.0),
    "score": _optional(1.0),
    "label": replace(_NAME, default="object"),
}
EGO = {"x": _NUMBER, "y": _NUMBER, "z": _optional(0.0), "yaw": _NUMBER}
_MODES = Field("true or false", _checked(lambda value: type(value) is bool), False, null=False)
_TYPE = {"type": Field("the type of a message", _NAME.read, "frame")}
MESSAGES: Mapping[str, Mapping[str, Field]] = {
    "frame": {
        **_TYPE,
        "seq": Field("an integer from 0 on", _checked(lambda value: type(value) is int and 0 <= value < 2**63), None),
        "timestamp": _NUMBER,
        "sensor": replace(_NAME, default="sensor"),
        "coordinates": Field(
            f"one of {', '.join(FRAMES)}", _checked(lambda value: value in FRAMES), "world", null=False
        ),
        "ego": Field("an object with x, y and yaw", _pose, None),
        "detections": Field("a list", _checked(lambda value: isinstance(value, list))),
    },
    "status": _TYPE,
    "subscribe": _TYPE,
    "predict": {**_TYPE, "horizons": Field(f"a list of at most {MAX_HORIZONS} s", _horizons), "modes": _MODES},
    "reset": {**_TYPE, "sensor": replace(_NAME, default=None)},
}
"""Fields of the messages that come in, by their type."""


@dataclass(frozen=True, eq=False)
class FrameMessage:
    """A frame, its number among the messages of its sensor (None: not numbered), and its headings (n,) as they came."""

    frame: Frame
    seq: int | None = None
    yaw: FloatArray = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, eq=False)
class Request:
    """A message that is no frame; kind: its type.

    sensor    of a reset of the number of one sensor alone, whose next frame may have any
    horizons  (H,) of a request for predictions, s after the newest frame
    modes     whether to list the modes of these
    """

    kind: str
    sensor: str | None = None
    horizons: FloatArray = field(default_factory=lambda: np.empty(0))
    modes: bool = False


def parse_message(line: bytes, settings: StreamSettings) -> FrameMessage | Request:
    """Read a line. Raises `InputError` naming the field and what was expected."""
    if len(line) > settings.max_message:
        raise InputError(f"message: expected at most {settings.max_message} bytes")
    try:
        message = json.loads(line.decode("utf-8"), parse_constant=_refuse_constant)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"message: broken JSON: {error}") from error
    if not isinstance(message, dict):
        raise InputError(f"message: expected an object, got {_short(message)}")
    kind = message.get("type", "frame")
    if not isinstance(kind, str) or kind not in MESSAGES:
        raise InputError(f"type: expected {', '.join(MESSAGES)}, got {_short(kind)}")
    values = _values("", message, MESSAGES[kind])
    del values["type"]
    return _frame_message(values, settings) if kind == "frame" else Request(kind, **values)


def tracks_message(tracks: Tracks) -> dict[str, Any]:
    """Return the answer to a frame: the tracks in world coordinates, with the columns of track files.

    `settled` is there where it is false alone, `relations` where there are any.
    """
    boxes, covariance = tracks.boxes, tracks.position_covariance
    numbers = np.column_stack(
        [
            *(boxes.position, boxes.size, boxes.yaw, boxes.velocity, tracks.score),
            *(covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1], tracks.coasting),
        ]
    )
    names = (*NUMBERS, "cov_xx", "cov_xy", "cov_yy", "coasting")
    rows = [
        {"id": id_, "label": label, **{name: x for name, x in zip(names, row, strict=True) if math.isfinite(x)}}
        for id_, label, row in zip(tracks.id.tolist(), boxes.label.tolist(), numbers.tolist(), strict=True)
    ]
    for row in np.flatnonzero(~tracks.settled).tolist():
        rows[row]["settled"] = False
    message = {"type": "tracks", "timestamp": tracks.timestamp, "tracks": rows}
    columns = ("source", "target", "relation", "probability")
    relations = [dict(zip(columns, row, strict=True)) for row in tracks.relations.rows()]
    return message | ({"relations": relations} if relations else {})


def predictions_message(predicted: PredictedTracks, modes: bool = False) -> dict[str, Any]:
    """Return the answer to a request for predictions, on request with `modes`: lists over the horizons, in world."""
    ids, horizons = predicted.id.tolist(), predicted.horizons.tolist()
    yaw = _finite({"yaw": predicted.yaw}, len(ids))
    rows = [
        {"id": id_, "label": label} | state | heading
        for id_, label, state, heading in zip(ids, predicted.label.tolist(), _states(predicted), yaw, strict=True)
    ]
    for mode in predicted.modes if modes else ():
        shares = _finite({"probability": mode.probability}, len(ids))
        for row, share, state in zip(rows, shares, _states(mode), strict=True):
            if len(share) + len(state) == 1 + len(STATE):  # all of it is finite
                row.setdefault("modes", []).append({"mode": mode.name} | share | state)
    return {"type": "predictions", "timestamp": predicted.timestamp, "horizons": horizons, "tracks": rows}


STATE = ("x", "y", "vx", "vy", "cov_xx", "cov_xy", "cov_yy")


def _states(predicted: PredictedTracks | PredictedMode) -> list[dict[str, Any]]:
    """Places, velocities and covariances of each track, lists over the horizons."""
    x, v, P = predicted.position, predicted.velocity, predicted.position_covariance
    columns = (*np.moveaxis(x, -1, 0), *np.moveaxis(v, -1, 0), P[..., 0, 0], P[..., 0, 1], P[..., 1, 1])
    return _finite(dict(zip(STATE, columns, strict=True)), x.shape[1])


def _finite(columns: Mapping[str, FloatArray], n: int) -> list[dict[str, Any]]:
    """The finite ones of columns (H, n) of each of n tracks, as lists."""
    found = {name: column.T.tolist() for name, column in columns.items()}
    return [{name: rows[k] for name, rows in found.items() if np.isfinite(rows[k]).all()} for k in range(n)]


def late_message(newest: float) -> dict[str, Any]:
    """Return the answer to a frame that came too late; `newest`: time of the tracks, s."""
    return {"type": "late", "timestamp": newest}


def unconfirmed_message(timestamp: float) -> dict[str, Any]:
    """Return the answer to a frame whose time, s, is far from all before."""
    text = f"timestamp: {timestamp:.3f} s is far from the newest frame; left out, unless the next one agrees"
    return {"type": "unconfirmed", "message": text}


def about(message: FrameMessage) -> dict[str, Any]:
    """Return the fields that identify a frame for its client."""
    known = {"sensor": message.frame.sensor, "frame_timestamp": message.frame.timestamp}
    return known if message.seq is None else {"seq": message.seq, **known}


def encode(message: Mapping[str, Any]) -> bytes:
    """Return the line of a message."""
    return json.dumps(message, allow_nan=False, separators=(",", ":")).encode() + b"\n"


class LineSplitter:
    """Joins pieces into lines of at most `limit` bytes. A longer one comes out as None, and is not kept meanwhile."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._unfinished = bytearray()
        self._too_long = False

    def __len__(self) -> int:
        """Bytes of the unfinished line."""
        return len(self._unfinished)

    def feed(self, piece: bytes) -> Iterator[bytes | None]:
        """Take in the next piece; yield the lines that end in it, without empty ones."""
        *ends, rest = piece.split(b"\n")
        for end in ends:
            self._add(end)
            yield from self.finish()
        self._add(rest)

    def finish(self) -> Iterator[bytes | None]:
        """Yield the unfinished line, if there is one, at the end of all pieces."""
        line = None if self._too_long else bytes(self._unfinished)
        self._unfinished, self._too_long = bytearray(), False
        if line is None or line.strip():
            yield line

    def _add(self, part: bytes) -> None:
        if self._too_long or len(self._unfinished) + len(part) > self._limit:
            self._unfinished, self._too_long = bytearray(), True
        else:
            self._unfinished += part


def _frame_message(values: Mapping[str, Any], settings: StreamSettings) -> FrameMessage:
    rows = values["detections"]
    if len(rows) > settings.max_detections:
        raise InputError(f"detections: expected at most {settings.max_detections}, got {len(rows)}")
    try:
        detections, yaw = _detections([_values(f"detections[{k}]", row, DETECTION) for k, row in enumerate(rows)])
        frame = Frame(values["timestamp"], values["sensor"], detections, values["ego"], values["coordinates"])
    except InputError as error:  # names the field as a frame has it
        raise InputError(re.sub("^world_T_ego:", "ego:", str(error))) from error
    return FrameMessage(frame, values["seq"], yaw)


def _detections(rows: Sequence[Mapping[str, Any]]) -> tuple[Detections, FloatArray]:
    """The detections, and their headings before they are wrapped."""

    def column(name: str) -> FloatArray:
        return np.array([row[name] for row in rows], dtype=np.float64)

    position, size, velocity = (np.stack([*map(column, names)], axis=-1) for names in (POSITION, SIZE, VELOCITY))
    yaw = column("yaw")
    boxes = Boxes.of([row["label"] for row in rows], position, size, yaw, velocity)
    return Detections(boxes, column("score"), column("range_rate")), yaw


def _values(where: str, given: Any, fields: Mapping[str, Field]) -> dict[str, Any]:
    """The values of the fields of an object, which is at `where` in a message; defaults for those left out."""
    if not isinstance(given, dict):
        raise InputError(f"{where}: expected an object, got {_short(given)}")
    if unknown := given.keys() - fields.keys():
        name = min(unknown)
        nearest = get_close_matches(name, fields, n=1, cutoff=0.6)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else f"; expected {', '.join(fields)}"
        raise InputError(f"{_dotted(where, _short(name))}: unknown field{hint}")
    values = {}
    for name, each in fields.items():
        if name in given and not (each.null and given[name] is None):
            values[name] = _value(_dotted(where, name), each, given[name])
        elif each.default is REQUIRED:
            raise InputError(f"{_dotted(where, name)}: expected {each.expected}, it is left out")
        else:
            values[name] = each.default
    return values


def _value(where: str, of: Field, given: Any) -> Any:
    try:
        return of.read(given)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: expected {of.expected}, got {_short(given)}") from None


def _dotted(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _refuse_constant(name: str) -> NoReturn:
    raise InputError(f"message: expected JSON, which has no {name}")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


class StreamClient:
    """A connection to a service; a context manager.

    Raises `InputError` where no service listens, and `ConnectionError` when the service goes away.
    """

    def __init__(self, address: Address, timeout: float | None = 30.0) -> None:
        family = (
            socket.AF_UNIX if address.path is not None else socket.AF_INET6 if ":" in address.host else socket.AF_INET
        )
        self._address = address
        self._socket = socket.socket(family)
        self._socket.settimeout(timeout)
        try:
            self._connect(timeout)
        except OSError as error:
            self._socket.close()
            raise InputError(f"{address}: nobody answers there: {error.strerror or error}") from error
        self._lines = self._socket.makefile("rb")

    def _connect(self, timeout: float | None) -> None:
        where = str(self._address.path) if self._address.path is not None else (self._address.host, self._address.port)
        end = time.monotonic() + (timeout or 0.0)
        while True:
            try:
                return self._socket.connect(where)
            except BlockingIOError:  # as many others wait to be accepted at this Unix socket as may
                if time.monotonic() > end:
                    raise
                time.sleep(0.01)

    def send(self, message: Mapping[str, Any] | bytes) -> None:
        """Send one message, or a raw line."""
        self._socket.sendall(message if isinstance(message, bytes) else encode(message))

    def receive(self) -> dict[str, Any]:
        """Return the next answer. Raises `InputError` for a line that is no JSON object."""
        line = self._lines.readline()
        if not line:
            raise ConnectionError("the service has closed the connection")
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self._address}: expected an answer in JSON, got {line[:80]!r}") from error
        if not isinstance(answer, dict):
            raise InputError(f"{self._address}: expected an object as answer, got {line[:80]!r}")
        return answer

    def ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Send one message; return the next answer."""
        self.send(message)
        return self.receive()

    def close(self) -> None:
        """Close the connection."""
        self._lines.close()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
