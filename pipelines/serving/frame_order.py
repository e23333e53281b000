"""Order of frames: their numbers, and several sensors put in order of time.

Numbers of frames: taken in, held, and covered by a state file.

A client may send a frame again whenever it is unsure; each is taken in once. Numbers of a sensor grow, with gaps where
the client left some out. Frames that are held back for reordering may go in after higher numbers of their sensor; those
below the last one that are still held are *open*: neither taken in nor to be forgotten.
"""

import heapq
import math
from collections import Counter
from itertools import count
from typing import Any, Generic, Literal, TypeVar

Known = Literal["taken", "unconfirmed"]


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
        """Go on from a state, without held frames."""
        self.last, self.taken = dict(state["last"]), Counter(state["taken"])
        self._open = {sensor: set(numbers) for sensor, numbers in state["open"].items()}
        self._unconfirmed = dict(state["unconfirmed"])
        self._held = {}


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
