"""One stream of messages into one tracker, and the answers to each line; frames are put in order before.

Numbers of frames: taken in, held, and covered by a state file.

A client may send a frame again whenever it is unsure; each is taken in once. Numbers of a sensor grow, with gaps where
the client left some out. Frames that are held back for reordering may go in after higher numbers of their sensor; those
below the last one that are still held are *open*: neither taken in nor to be forgotten.
"""

import heapq
import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import count
from typing import Any, Generic, Literal, Protocol, TypeVar

import numpy as np

from pipelines.checks import Checks
from pipelines.serving.messages import (
    FrameMessage,
    about,
    late_message,
    parse_message,
    predictions_message,
    tracks_message,
    unconfirmed_message,
)
from pipelines.serving.settings import LogLimit, StreamSettings
from pipelines.tracking import OnlineTracker, compared_clocks, resident_memory
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray
from saga_fg.tracking import GreedyTracker, SensorTime
from saga_fg.types import Tracks

Known = Literal["taken", "unconfirmed"]
_MAX_SEQ_JUMP = 1_000_000  # of one sensor: a number further ahead is damaged, and would refuse all later ones


class Numbering:
    """Frame numbers by sensor, of at most `max_sensors`: one more, and the sensor silent for longest is forgotten.

    last   the highest number that was taken in; the sensor silent for longest first
    taken  how many numbered frames were taken in
    """

    def __init__(self, max_sensors: float = math.inf) -> None:
        self._max_sensors = max_sensors
        self.last: dict[str, int] = {}
        self.taken: Counter[str] = Counter()
        self._held: dict[str, set[int]] = {}
        self._open: dict[str, set[int]] = {}  # of a restored state: held there, and not sent again so far
        self._unconfirmed: dict[str, int] = {}  # the latest frame left out until the next one agrees

    def known(self, sensor: str, number: int) -> Known | None:
        """Return how this frame was judged before, None for a new one."""
        if self._unconfirmed.get(sensor) == number:  # else it would confirm itself
            return "unconfirmed"
        if number in self._held.get(sensor, ()):
            return "taken"
        return "taken" if number <= self.last.get(sensor, -1) and number not in self._open.get(sensor, ()) else None

    def hold(self, sensor: str, number: int) -> None:
        """Note a frame that waits for its turn."""
        self._held.setdefault(sensor, set()).add(number)

    def release(self, sensor: str, number: int) -> None:
        """Note that its turn has come."""
        held = self._held.get(sensor, set())
        held.discard(number)
        if not held:
            self._held.pop(sensor, None)

    def take(self, sensor: str, number: int) -> list[str]:
        """Note a frame that was taken in, or left out for good; return the sensors that are forgotten for it."""
        self.taken[sensor] += 1
        still = self._open.get(sensor, set())
        if number in still:
            still.discard(number)
        elif number > self.last.get(sensor, -1):  # the client goes on, and will not send the others again
            still.clear()
        if not still:
            self._open.pop(sensor, None)
        self.last[sensor] = max(self.last.pop(sensor, -1), number)
        forgotten = []
        while len(self.last) > self._max_sensors:
            forgotten.append(next(iter(self.last)))
            self.forget(forgotten[-1])
        return forgotten

    def leave_out(self, sensor: str, number: int) -> None:
        """Note a frame that was left out unless the next one agrees."""
        self._unconfirmed.pop(sensor, None)
        self._unconfirmed[sensor] = number
        if len(self._unconfirmed) > self._max_sensors:
            del self._unconfirmed[next(iter(self._unconfirmed))]

    def forget(self, sensor: str) -> None:
        """Forget the numbers of a sensor, whose next frame may have any."""
        for numbers in (self.last, self.taken, self._held, self._open, self._unconfirmed):
            numbers.pop(sensor, None)

    def durable(self) -> dict[str, int]:
        """Return by sensor the number up to which all frames are settled: after it a client goes on from the state."""
        return {
            sensor: min([last, *(n - 1 for n in self._held.get(sensor, set()) | self._open.get(sensor, set()))])
            for sensor, last in self.last.items()
        }

    def state(self) -> dict[str, Any]:
        """Return the state as plain values; held frames are open in it."""
        unsettled = {
            sensor: sorted(n for n in self._held.get(sensor, set()) | self._open.get(sensor, set()) if n < last)
            for sensor, last in self.last.items()
        }
        return {
            "last": dict(self.last),
            "taken": dict(self.taken),
            "open": {sensor: numbers for sensor, numbers in unsettled.items() if numbers},
            "unconfirmed": dict(self._unconfirmed),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state, without held frames. Raises `InputError` for numbers that are none."""
        for name in ("last", "taken", "unconfirmed"):
            _require_whole(name, state[name].values())
        for numbers in state["open"].values():
            _require_whole("open", numbers)
        self.last, self.taken = dict(state["last"]), Counter(state["taken"])
        self._open = {sensor: set(numbers) for sensor, numbers in state["open"].items()}
        self._unconfirmed = dict(state["unconfirmed"])
        self._held = {}


def _require_whole(name: str, numbers: Iterable[object]) -> None:
    if not all(type(number) is int for number in numbers):
        raise InputError(f"{name}: expected whole numbers")


T = TypeVar("T")


class Reordering(Generic[T]):
    """Holds frames back until the newest one is `hold` s younger, and at most `max_held` of them.

    No frame waits longer than the stream takes to advance by `hold`. A frame that comes later still is passed on at
    once. So is a frame further than `max_jump` s from the newest one, after all held frames; the newest time then stays
    until `set_clock`.
    """

    def __init__(self, hold: float, max_held: int, max_jump: float = math.inf) -> None:
        self._hold, self._max_held, self._max_jump = hold, max_held, max(max_jump, hold)
        self._heap: list[tuple[float, int, T]] = []
        self._arrival = count()
        self.newest = -math.inf

    def __len__(self) -> int:
        return len(self._heap)

    def jumps(self, timestamp: float) -> bool:
        """Return True for a time, s, further than `max_jump` from the newest one."""
        return self.newest > -math.inf and abs(timestamp - self.newest) > self._max_jump

    def push(self, timestamp: float, item: T) -> list[T]:
        """Take in an item; return those whose turn has come, in order of time and, at one time, of arrival."""
        if self.jumps(timestamp):
            return [*self.flush(), item]
        self.newest = max(self.newest, timestamp)
        heapq.heappush(self._heap, (timestamp, next(self._arrival), item))
        due = []
        while self._heap and (self._heap[0][0] <= self.newest - self._hold or len(self._heap) > self._max_held):
            due.append(heapq.heappop(self._heap)[2])
        return due

    def flush(self) -> list[T]:
        """Release all items, in order of time."""
        return [heapq.heappop(self._heap)[2] for _ in range(len(self._heap))]

    def set_clock(self, timestamp: float) -> None:
        """Set the newest time, s; minus infinity for none."""
        self.newest = timestamp


log = logging.getLogger(__name__)

Client = TypeVar("Client")
Answer = dict[str, Any]

LATENCIES = 10_000  # latest frames, whose latencies are kept
COUNTED = (
    *("messages", "frames", "out_of_order", "late", "unconfirmed", "repeats", "refused", "jumps"),
    *("unsettled", "failures", "restarts"),
)

MAX_HELD = 256  # largest number of frames held back; beyond it the oldest is tracked


class StateSaver(Protocol):
    """Keeper of the stream's state on the disk, `pipelines.serving.state.StateKeeper`."""

    def save(self) -> bool:
        """Write the state; return True if it is on the disk now."""

    def status(self) -> dict[str, Any]:
        """Return the age of the file and the latest error."""


@dataclass(frozen=True, eq=False)
class _Held(Generic[Client]):
    message: FrameMessage
    client: Client
    received: float


class StreamTracker(Generic[Client]):
    """Takes lines of any number of clients and returns the answers with the clients they are for.

    new_tracker  makes a tracker; called at the start, on a reset, and after repeated internal errors
    settings     limits of the stream
    checks       warns of what is doubtful in the first frames, None: nothing is said
    horizons     (H,) s, to which every answer to a frame has predictions; None for none
    shown        makes the answer of the tracks at a frame
    keeper       keeps the state in a file, None: nothing is kept

    A line that cannot be used is answered, counted and otherwise without effect; so is one that makes the tracker fail.
    Frames that carry `seq`, the number of the message among those of its sensor, are taken in once: after a lost
    connection, or a killed service that kept its state, a client sends again what may be lost. One thread at a time.
    """

    def __init__(
        self,
        new_tracker: Callable[[], OnlineTracker],
        settings: StreamSettings | None = None,
        checks: Checks | None = None,
        horizons: FloatArray | None = None,
        shown: Callable[[Tracks], Answer] = tracks_message,
    ) -> None:
        self.settings = settings or StreamSettings()
        self.counts: Counter[str] = Counter()
        self._latencies: deque[float] = deque(maxlen=LATENCIES)  # ms
        self.keeper: StateSaver | None = None
        self.version = 0  # grows whenever there is something new to keep
        self._new_tracker = new_tracker
        self._tracker = new_tracker()
        self._held: Reordering[_Held[Client]] = Reordering(self.settings.reorder, MAX_HELD, self._tracker.max_jump)
        self._numbering = Numbering(self.settings.max_sensors)
        self._durable: dict[str, int] = {}
        self._failed_in_a_row = 0
        self._log_limit = LogLimit()
        self._checks = checks
        self._horizons = horizons
        self._shown = shown
        self._started = time.monotonic()
        self._lock = threading.Lock()

    def handle(
        self, line: bytes | FrameMessage | None, client: Client, received: float | None = None
    ) -> list[tuple[Client, Answer]]:
        """Return the answers to one line of a client, and to held frames whose turn has come with it.

        line: None for one that was too long, a frame where it was read elsewhere; received: time of reading, by
        `time.monotonic()`
        """
        if isinstance(line, bytes) and not line.strip():
            return []
        with self._lock:
            self.counts["messages"] += 1
            try:
                answers = self._handle(line, client, time.monotonic() if received is None else received)
            except InputError as error:
                return [(client, self._refused(error))]
            except Exception as error:
                return [(client, self._failed(error))]
        if self.keeper is not None and answers and answers[-1][1]["type"] == "reset":
            answers[-1][1]["durable"] = self.keeper.save()  # frames can be sent again, a reset could not
        return answers

    def refuse(self, error: InputError) -> Answer:
        """Count a message that could not be read elsewhere; return the answer."""
        with self._lock:
            self.counts["messages"] += 1
            return self._refused(error)

    def flush(self) -> list[tuple[Client, Answer]]:
        """Take in all frames that are held back, at the end of a stream; return their answers."""
        with self._lock:
            return self._flush()

    def status(self) -> Answer:
        """Return the counts since the start, latencies of the last frames in ms, memory in MB."""
        percents = (50, 90, 99, 99.9)
        latencies = np.percentile(self._latencies, percents).round(3).tolist() if self._latencies else ()
        kept = {} if self.keeper is None else {"durable_seq": dict(self._durable), "state": self.keeper.status()}
        return {
            "type": "status",
            "seconds": round(time.monotonic() - self._started, 3),
            **{name: self.counts[name] for name in COUNTED},
            "held": len(self._held),
            "latency_ms": {f"p{percent:g}": ms for percent, ms in zip(percents, latencies, strict=False)},
            "memory_mb": round(resident_memory(), 1),
            "cpu_seconds": round(time.process_time(), 3),
            "last_seq": dict(self._numbering.last),
            "taken": dict(self._numbering.taken),
            "clocks": {name: _rounded(asdict(each)) for name, each in self.clocks().items()},
            **kept,
        }

    def clocks(self) -> dict[str, SensorTime]:
        """Return the clocks of the sensors, where there are several."""
        return compared_clocks(self._tracker)

    def state(self) -> tuple[dict[str, Any], dict[str, int], int]:
        """Return the state (without held frames) as a tree of values, the last number of each sensor, the version."""
        with self._lock:
            state = {
                "tracker": self._tracker.snapshot(),
                "numbering": self._numbering.state(),
                "newest": self._held.newest,
                "counts": dict(self.counts),
            }
            return state, self._numbering.durable(), self.version

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state. Raises `InputError` for counts that are none."""
        counts = Counter(state["counts"])
        _require_whole("counts", counts.values())
        with self._lock:
            self._tracker.restore(state["tracker"])
            self._numbering.restore(state["numbering"])
            self._held.set_clock(float(state["newest"]))
            self.counts = counts
            self._durable = self._numbering.durable()

    def made_durable(self, durable: dict[str, int]) -> None:
        """Note that a state with these numbers is on the disk, for the answers from now on."""
        self._durable = durable

    def _handle(
        self, line: bytes | FrameMessage | None, client: Client, received: float
    ) -> list[tuple[Client, Answer]]:
        if line is None:
            raise InputError(f"message: expected at most {self.settings.max_message} bytes")
        message = line if isinstance(line, FrameMessage) else parse_message(line, self.settings)
        if isinstance(message, FrameMessage):
            return self._take(_Held(message, client, received))
        if message.kind == "status":
            return [(client, self.status())]
        if message.kind == "subscribe":
            return [(client, {"type": "subscribe"})]
        if message.kind == "predict":
            return [(client, self._predictions(message.horizons, message.modes))]
        answers = self._flush()  # held frames would bring numbers back
        if message.sensor is None:
            before: Any = self._tracker
            self._begin_anew()
            self._tracker.take_clocks(before)
            return [*answers, (client, {"type": "reset"})]
        self._forget(message.sensor)
        self.version += 1
        return [*answers, (client, {"type": "reset", "sensor": message.sensor})]

    def _take(self, held: _Held[Client]) -> list[tuple[Client, Answer]]:
        message = held.message
        timestamp, sensor, number = message.frame.timestamp, message.frame.sensor, message.seq
        if number is not None:
            last = self._numbering.last.get(sensor)
            if last is not None and number > last + _MAX_SEQ_JUMP:
                most = last + _MAX_SEQ_JUMP
                raise InputError(f"seq: expected at most {most} after {last}, the last one of {sensor!r}, got {number}")
            known = self._numbering.known(sensor, number)
            if known is not None:
                self.counts["repeats"] += 1
                repeat = {"type": "repeat", "last_seq": -1 if last is None else last}
                answer = repeat if known == "taken" else unconfirmed_message(timestamp)
                return [(held.client, answer | self._about(message))]
        self.counts["out_of_order"] += timestamp < self._held.newest and not self._held.jumps(timestamp)
        due = self._held.push(timestamp, held)
        answers: list[tuple[Client, Answer]] = []
        if not any(each is held for each in due):
            if number is not None:
                self._numbering.hold(sensor, number)
            answers.append((held.client, {"type": "held", **self._about(message)}))
        return answers + [self._step(each) for each in due]

    def _flush(self) -> list[tuple[Client, Answer]]:
        return [self._step(held) for held in self._held.flush()]

    def _step(self, held: _Held[Client]) -> tuple[Client, Answer]:
        frame, number = held.message.frame, held.message.seq
        if number is not None:
            self._numbering.release(frame.sensor, number)
        self.version += 1
        try:
            answer = self._tracked(held.message)
        except InputError as error:
            return held.client, self._refused(error) | self._about(held.message)
        except Exception as error:
            return held.client, self._failed(error) | self._about(held.message)
        self._failed_in_a_row = 0
        self._latencies.append(1e3 * (time.monotonic() - held.received))
        return held.client, answer

    def _tracked(self, message: FrameMessage) -> Answer:
        """Take in one frame. Raises the errors of the tracker."""
        frame, number = message.frame, message.seq
        tracks = self._tracker.step(frame)
        if self._checks is not None:
            self._checks.watch(frame, message.yaw, tracks)
        verdict = self._tracker.time_verdict
        if verdict == "unconfirmed":
            self.counts["unconfirmed"] += 1
            if number is not None:
                self._numbering.leave_out(frame.sensor, number)
            return unconfirmed_message(frame.timestamp) | self._about(message)
        if number is not None:
            for silent in self._numbering.take(frame.sensor, number):
                self._forget(silent)
                if self._log_limit.due("sensors"):
                    most = self.settings.max_sensors
                    log.warning("more than %d numbered sensors: the number of %r is forgotten", most, silent)
        if verdict == "late":
            self.counts["late"] += 1
            return late_message(tracks.timestamp) | self._about(message)
        self.counts["frames"] += 1
        self.counts["unsettled"] += int(not tracks.settled.all())
        if verdict == "accepted":
            self._held.set_clock(max(self._held.newest, frame.timestamp))
            clock = {}
        else:
            self.counts["jumps"] += 1
            self._held.set_clock(frame.timestamp)
            clock = {"clock": verdict}
        predicted = {} if self._horizons is None else {"predictions": self._predictions(self._horizons)}
        return self._shown(tracks) | predicted | clock | self._about(message)

    def _predictions(self, horizons: FloatArray, modes: bool = False) -> Answer:
        """Return the tracks at times after the newest frame, s. Raises `InputError` where there are none."""
        if isinstance(self._tracker, GreedyTracker):
            raise InputError("predict: expected --method saga or kf, centerpoint predicts nothing")
        return predictions_message(self._tracker.predict(horizons, hypotheses=modes), modes)

    def _about(self, message: FrameMessage) -> Answer:
        """Return the fields that identify a frame for its client, and the last number of its sensor on the disk."""
        known = about(message)
        if self.keeper is not None and message.seq is not None:
            known["durable_seq"] = self._durable.get(message.frame.sensor, -1)
        return known

    def _refused(self, error: InputError) -> Answer:
        self.counts["refused"] += 1
        return {"type": "error", "message": str(error), "number": self.counts["messages"]}

    def _failed(self, error: Exception) -> Answer:
        """Count and answer an error that is no fault of the message; after several in a row, begin anew."""
        if self._log_limit.due(_origin(error)):
            log.error("message %d: internal error, the service goes on", self.counts["messages"], exc_info=error)
        self.counts["failures"] += 1
        self._failed_in_a_row += 1
        if self._failed_in_a_row >= self.settings.max_failures:
            if self._log_limit.due("restart"):
                log.error("%d internal errors in a row: a fresh tracker begins", self._failed_in_a_row)
            self.counts["restarts"] += 1
            self._begin_anew()
        text = f"internal error: {type(error).__name__}: {' '.join(str(error).split())[:300]}"
        return {"type": "error", "message": text, "number": self.counts["messages"]}

    def _forget(self, sensor: str) -> None:
        """Forget the numbers of a sensor."""
        self._numbering.forget(sensor)
        self._durable.pop(sensor, None)

    def _begin_anew(self) -> None:
        """Begin with a fresh tracker; `seq` goes on."""
        self._tracker = self._new_tracker()
        self._held.set_clock(-math.inf)
        self._failed_in_a_row = 0
        self.version += 1


def _origin(error: Exception) -> tuple[str, int]:
    """Return the type of an error, and the line it comes from."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return type(error).__name__, 0 if trace is None else trace.tb_lineno


def _rounded(values: Answer) -> Answer:
    """Return the times to the microsecond."""
    return {name: round(value, 6) if isinstance(value, float) else value for name, value in values.items()}
