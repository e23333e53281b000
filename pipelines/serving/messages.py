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
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, NoReturn, cast

import numpy as np

from pipelines.serving.settings import StreamSettings
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Coordinates, Detections, Frame
from saga_fg.types.track import PredictedTracks, Tracks, checked_horizons

REQUESTS = ("status", "subscribe", "predict", "reset")
MAX_HORIZON = 10.0  # furthest time of a prediction, s
MAX_HORIZONS = 20  # largest number of times of a prediction

POSITION, SIZE, VELOCITY = ("x", "y", "z"), ("length", "width", "height"), ("vx", "vy")
NUMBERS = (*POSITION, *SIZE, "yaw", *VELOCITY, "score")
MEASURED = (*NUMBERS, "range_rate")  # of a detection
FRAME_KEYS = ("type", "seq", "timestamp", "sensor", "coordinates", "ego", "detections")
DEFAULTS = {"z": 0.0, "score": 1.0}
_ABSENT = tuple((name, None if name in ("x", "y") else DEFAULTS.get(name, np.nan)) for name in MEASURED)
_DETECTION_KEYS = frozenset(("label", *MEASURED))
LONGEST_NAME = 64  # characters of a label or a sensor: names are kept


@dataclass(frozen=True, eq=False)
class FrameMessage:
    """A frame, its number among the messages of its sensor (None: not numbered), and its headings (n,) as they came."""

    frame: Frame
    seq: int | None = None
    yaw: FloatArray = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, eq=False)
class Request:
    """One of `REQUESTS`.

    sensor    of a reset of the number of one sensor alone, whose next frame may have any
    horizons  (H,) of a request for predictions, s after the newest frame
    """

    kind: str
    sensor: str | None = None
    horizons: FloatArray = field(default_factory=lambda: np.empty(0))


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
    if kind == "frame":
        return _frame_message(message, settings)
    if kind not in REQUESTS:
        raise InputError(f"type: expected frame, {', '.join(REQUESTS)}, got {_short(kind)}")
    if kind == "reset" and "sensor" in message:
        _known("", message, ("type", "sensor"))
        return Request(kind, _name("", message, "sensor", ""))
    if kind == "predict":
        _known("", message, ("type", "horizons"))
        return Request(kind, horizons=stream_horizons(message.get("horizons"), settings))
    _known("", message, ("type",))
    return Request(kind)


def stream_horizons(given: Any, settings: StreamSettings) -> FloatArray:
    """Return horizons (H,), s. Raises `InputError` unless they are increasing numbers within the stream's limits."""
    if not isinstance(given, list) or len(given) > MAX_HORIZONS:
        raise InputError(f"horizons: expected a list of at most {MAX_HORIZONS} s, got {_short(given)}")
    horizons = checked_horizons([_number("horizons", {"": each}, "") for each in given])
    if horizons[-1] > MAX_HORIZON:
        raise InputError(f"horizons: expected at most {MAX_HORIZON:g} s, got {horizons[-1]:g}")
    return horizons


def tracks_message(tracks: Tracks) -> dict[str, Any]:
    """Return the answer to a frame: the tracks in world coordinates, with the columns of track files.

    `settled` is there where it is false alone.
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
    return {"type": "tracks", "timestamp": tracks.timestamp, "tracks": rows}


def predictions_message(predicted: PredictedTracks) -> dict[str, Any]:
    """Return the answer to a request for predictions: lists over the horizons, in world coordinates."""
    P = predicted.position_covariance
    numbers = np.stack(
        [
            *np.moveaxis(predicted.position, -1, 0),
            *np.moveaxis(predicted.velocity, -1, 0),
            predicted.yaw,
            *(P[..., 0, 0], P[..., 0, 1], P[..., 1, 1]),
        ]
    )
    names = ("x", "y", "vx", "vy", "yaw", "cov_xx", "cov_xy", "cov_yy")
    rows = [
        {"id": id_, "label": label}
        | {name: x for name, x in zip(names, numbers[:, :, n].tolist(), strict=True) if np.isfinite(x).all()}
        for n, (id_, label) in enumerate(zip(predicted.id.tolist(), predicted.label.tolist(), strict=True))
    ]
    horizons = predicted.horizons.tolist()
    return {"type": "predictions", "timestamp": predicted.timestamp, "horizons": horizons, "tracks": rows}


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


def _frame_message(message: Mapping[str, Any], settings: StreamSettings) -> FrameMessage:
    _known("", message, FRAME_KEYS)
    seq = message.get("seq")
    if seq is not None and (type(seq) is not int or not 0 <= seq < 2**63):
        raise InputError(f"seq: expected an integer from 0 on, got {_short(seq)}")
    rows = message.get("detections")
    if not isinstance(rows, list):
        raise InputError(f"detections: expected a list, got {_short(rows)}")
    if len(rows) > settings.max_detections:
        raise InputError(f"detections: expected at most {settings.max_detections}, got {len(rows)}")
    coordinates = message.get("coordinates", "world")
    try:
        detections, yaw = _detections(rows)
        frame = Frame(
            timestamp=_number("", message, "timestamp"),
            sensor=_name("", message, "sensor", "sensor"),
            detections=detections,
            world_T_ego=_pose(message["ego"]) if message.get("ego") is not None else None,
            coordinates=cast(Coordinates, coordinates if isinstance(coordinates, str) else repr(coordinates)),
        )
    except InputError as error:  # names the field as a frame has it
        raise InputError(re.sub("^world_T_ego:", "ego:", str(error))) from error
    return FrameMessage(frame, seq, yaw)


def _detections(rows: Sequence[Any]) -> tuple[Detections, FloatArray]:
    """The detections, and their headings before they are wrapped."""
    labels, numbers = _plain_rows(rows) or _checked_rows(rows)
    columns = dict(zip(MEASURED, numbers.T, strict=True))

    def stacked(names: Sequence[str]) -> FloatArray:
        return np.stack([columns[name] for name in names], axis=-1)

    boxes = Boxes.of(labels, stacked(POSITION), stacked(SIZE), columns["yaw"], stacked(VELOCITY))
    return Detections(boxes, columns["score"], columns["range_rate"]), columns["yaw"]


def _plain_rows(rows: Sequence[Any]) -> tuple[list[str], FloatArray] | None:
    """Labels (m,) and numbers (m, len(MEASURED)) of detections; None where one of them is not as it should be."""
    if not all(type(row) is dict and row.keys() <= _DETECTION_KEYS for row in rows):
        return None
    labels = [row.get("label", "object") for row in rows]
    if not all(type(label) is str and 0 < len(label) <= LONGEST_NAME for label in labels):
        return None
    values = [row.get(name, absent) for row in rows for name, absent in _ABSENT]
    if not {type(value) for value in values} <= {int, float}:
        return None
    try:
        numbers = np.array(values, dtype=np.float64).reshape(len(rows), len(MEASURED))
    except OverflowError:
        return None
    return None if np.isinf(numbers).any() else (labels, numbers)  # JSON has no NaN: that is what is left out


def _checked_rows(rows: Sequence[Any]) -> tuple[list[str], FloatArray]:
    """Check row by row; raises `InputError` for the first bad one."""
    numbers = np.empty((len(rows), len(MEASURED)))
    labels = []
    for k, row in enumerate(rows):
        where = f"detections[{k}]"
        if not isinstance(row, dict):
            raise InputError(f"{where}: expected an object, got {_short(row)}")
        _known(f"{where}.", row, ("label", *MEASURED))
        labels.append(_name(f"{where}.", row, "label", "object"))
        numbers[k] = [_number(f"{where}.", row, name, absent) for name, absent in _ABSENT]
    return labels, numbers


def _pose(ego: Any) -> FloatArray:
    if not isinstance(ego, dict):
        raise InputError(f"ego: expected an object with x, y and yaw, got {_short(ego)}")
    _known("ego.", ego, ("x", "y", "z", "yaw"))
    return yaw_transform(*(_number("ego.", ego, name, 0.0 if name == "z" else None) for name in ("x", "y", "z", "yaw")))


def _number(where: str, values: Mapping[str, Any], name: str, default: float | None = None) -> float:
    value = values.get(name)
    if value is None and default is not None:
        return default
    if type(value) not in (int, float):
        got = "it is left out" if value is None else f"got {_short(value)}"
        raise InputError(f"{where}{name}: expected a number, {got}")
    try:
        number = float(cast(float, value))
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{where}{name}: expected a finite number, got {_short(value)}")
    return number


def _name(where: str, values: Mapping[str, Any], name: str, default: str) -> str:
    value = values.get(name, default)
    if not isinstance(value, str) or not 0 < len(value) <= LONGEST_NAME:
        raise InputError(f"{where}{name}: expected a name of 1 to {LONGEST_NAME} characters, got {_short(value)}")
    return value


def _known(where: str, values: Mapping[str, Any], names: Sequence[str]) -> None:
    unknown = values.keys() - set(names)
    if unknown:
        name = min(unknown)
        nearest = get_close_matches(name, names, n=1, cutoff=0.6)
        hint = f"; did you mean {nearest[0]!r}?" if nearest else f"; expected {', '.join(names)}"
        raise InputError(f"{where}{_short(name)}: unknown field{hint}")


def _refuse_constant(name: str) -> NoReturn:
    raise InputError(f"message: expected JSON, which has no {name}")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
