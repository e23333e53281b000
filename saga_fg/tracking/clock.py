"""The time of a tracker: a consensus of its sensors' clocks, and a verdict on the timestamp of every frame.

A wrong clock shuts out its own sensor, never the others. Each sensor's clock is known by its usual step between two
frames, its offset, and its record: the share of its frames that kept that step. With t the time of a frame, its
timestamp less the offset of its sensor (`saga_fg.tracking.clock_offsets`), and the newest time of all:

    -max_delay <= t - newest <= max_jump   accepted, unless t is out of consensus
    |t - newest| > max_jump                unconfirmed: left out, until others or further frames confirm it
    else                                   late: left out

A time ahead of the newest one is out of consensus where it surprises its own sensor and most of the others that are
live, by their records and not by their rates, itself included. It surprises a sensor r with

    t - t_r > max(max_delay, w_r + max_delay / 2, 2.2 step_r)

with t_r the time of that sensor's latest frame and w_r how long ago that came: the elapsed time, which advances with
the newest time, but with each frame by a few usual steps of its sensor at most. Were such a frame accepted, the next
frames of the others would be late. So it is unconfirmed. So is a frame of a sensor that leads the others by nearly
`max_delay`. A sensor too slow to tell has no vote.

Frames that are left out are evidence for another time, on which the sensors vote by their records. Those that propose
about the same time set the clock once they outweigh those that go on at the newest one. If no other sensor is live, a
second frame of the sensor is enough for a jump (one that was never in time needs `RESET_AFTER`); and `RESET_AFTER`
frames in a row in which its time decreases set the clock back. Frames that came in a burst after a stall, and frames
that are sent again, are no evidence. A stream whose steps are longer than `max_jump` is recognised by two equal steps,
and then has its own limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from saga_fg.numerics import unchecked

MAX_JUMP = 10.0  # s, as a tracker starts with
RESET_AFTER = 3  # frames in a row in which the time of a sensor decreases, and that set the clock back
REMEMBERED = 200  # accepted frames, by which repeated frames are recognised
MANY_SENSORS = 32  # from here on, sensors of short records are forgotten: names come from outside
REGULAR = 2.2  # steps of a sensor, up to which the next frame may take: one frame may be missing
QUIET = 1.0  # s; a sensor that has sent nothing for longer, and for four steps, has no vote
LEAD = 0.9  # of max_delay: a sensor may lead the others by this much
LEFT_OUT = 0.1  # factor on the record of a sensor whose frames are left out
SMOOTHING = 1 / 8  # weight of the latest frame in the jitter and in the lead
LONG_RECORD = 1000  # frames; older ones count less and less

TimeVerdict = Literal["accepted", "late", "unconfirmed", "set_ahead", "set_back"]
"""Verdict on the time of a frame: late and unconfirmed frames are left out, others used; with set_ahead and set_back
the clock was first set to the frame's time."""
Stamp = tuple[str, float]
"""Sensor and time of a frame, s."""


@dataclass(frozen=True)
class SensorClock:
    """The clock of one sensor. Times in s; `elapsed` times are on the tracker's counter of that name.

    name       of the sensor
    stamp      its latest timestamp, as sent
    seen       elapsed time of its latest frame
    step       its usual time between two frames, 0 while unknown
    jitter     mean deviation from that step
    offset     subtracted from its timestamps
    lead       mean time of its accepted frames less the newest time, where those that set it are at 0
    kept       frames that kept its step
    broken     frames that did not
    segment    number of breaks of its time so far; what was learned of its offset before the latest is void
    time       of its latest accepted frame, None if there is none that is still believed
    taken      elapsed time of that frame; of the first one that was left out, if `time` is None
    doubt      the time of its latest frame, if that was left out
    first      the time of the first frame left out in a row
    run        frames in a row that support `doubt`
    """

    name: str
    stamp: float
    seen: float
    step: float = 0.0
    jitter: float = 0.0
    offset: float = 0.0
    lead: float = 0.0
    kept: int = 0
    broken: int = 0
    segment: int = 0
    time: float | None = None
    taken: float = 0.0
    doubt: float | None = None
    first: float = 0.0
    run: int = 0

    def changed(self, **values: Any) -> SensorClock:
        """With other values of some attributes."""
        return unchecked(SensorClock, **vars(self) | values)

    @property
    def record(self) -> float:
        """Weight of its vote, 0 to 1: the squared share of frames that kept its step, small while there are few, and
        where steps are irregular. By the square a few regular sensors outweigh many irregular ones."""
        regular = self.step / (self.step + self.jitter) if self.step else 1.0
        return (regular * (self.kept + 1) / (self.kept + self.broken + 4)) ** 2

    @property
    def trusted(self) -> bool:
        """Return True if its frames are accepted, but for one at most."""
        return self.time is not None and self.run <= 1

    def live(self, elapsed: float) -> bool:
        """Return True if it has a usual step and its latest frame is not long ago."""
        return self.step > 0 and elapsed - self.seen <= max(4 * self.step, QUIET)

    def surprised(self, time: float, waited: float, max_delay: float) -> bool:
        """Return True if a time, s, is further ahead than its next frame may be, `waited` s after its latest."""
        return self.time is None or time - self.time > max(max_delay, waited + max_delay / 2, REGULAR * self.step)

    def slower(self, time: float, max_delay: float) -> bool:
        """Return True if it is too slow to tell whether such a time, s, is right: its next frame may be further off."""
        return self.time is not None and max_delay < time - self.time <= REGULAR * self.step

    def with_time(self, time: float, elapsed: float, max_delay: float) -> bool:
        """Return True if its latest accepted frame was about as far before a time, s, as it came before it."""
        return self.time is not None and abs(self.time + elapsed - self.seen - time) <= max_delay / 2 + self.step

    def paced(self, time: float, elapsed: float, max_delay: float) -> bool:
        """Return True if a time, s, has advanced as the elapsed time has: the frame does not come after a stall."""
        start = self.first if self.time is None else self.time
        return abs(time - start - (elapsed - self.taken)) <= max_delay + REGULAR * self.step

    def step_to(self, timestamp: float) -> float:
        """The time, s, from its latest frame to one with this timestamp; from its latest accepted one if that is
        nearer."""
        d = timestamp - self.stamp
        return d if self.doubt is None or self.time is None else min(d, timestamp - self.offset - self.time, key=abs)

    def arrived(self, timestamp: float, waited: float) -> SensorClock:
        """After a frame with this timestamp, s, `waited` s of elapsed time after the one before."""
        d, step = self.step_to(timestamp), self.step
        broken = d < -max(0.05, step) or (step > 0 and d > 2.5 * step + 0.1 and d > waited + step + 0.1)
        jitter = self.jitter
        if step == 0 and d > 0:
            step = min(d, QUIET)
        elif d > 0 and not broken:
            jitter += SMOOTHING * (min(abs(d - step), step) - jitter)
            step *= min(max(d / step, 0.8), 1.25)
        kept, breaks = self.kept + (not broken), self.broken + broken
        if kept + breaks > LONG_RECORD:
            kept, breaks = kept // 2, breaks // 2
        return self.changed(
            stamp=timestamp,
            step=step,
            jitter=jitter,
            kept=kept,
            broken=breaks,
            segment=self.segment + broken,
            lead=0.0 if broken else self.lead,
        )


@dataclass(frozen=True)
class Clock:
    """The newest time, s, and what is known of the sensors' clocks. A value: `judged` returns the clock after a frame.

    newest       of the frames accepted, -inf before the first
    accepted     the latest of them, since the clock was set, by their timestamps
    step         the latest step of a slow stream, 0 of others, s
    elapsed      time since the start, without the jumps of the newest time, s
    reached      of that, when the newest time was last advanced
    sensors      their clocks
    """

    newest: float = -math.inf
    accepted: tuple[Stamp, ...] = ()
    step: float = 0.0
    elapsed: float = 0.0
    reached: float = 0.0
    sensors: tuple[SensorClock, ...] = ()

    def sensor(self, name: str) -> SensorClock | None:
        """The clock of a sensor, None if nothing is known of it."""
        return next((each for each in self.sensors if each.name == name), None)

    def time_of(self, timestamp: float, sensor: str) -> float:
        """The time of a frame, s, by the consensus of the sensors."""
        own = self.sensor(sensor)
        return timestamp if own is None or own.offset == 0 else timestamp - own.offset

    def records(self) -> dict[str, float]:
        """The weights of the sensors' votes by name; those of sensors that are left out are small."""
        return {r.name: r.record * (1.0 if r.trusted else LEFT_OUT) for r in self.sensors if r.step > 0}

    def begun_anew(self) -> Clock:
        """Without the time, as a new scene begins: what stays are the steps and records of the sensors."""
        forgotten = {"offset": 0.0, "time": None, "doubt": None, "run": 0, "lead": 0.0}
        return Clock(
            elapsed=self.elapsed, reached=self.elapsed, sensors=tuple(r.changed(**forgotten) for r in self.sensors)
        )

    def judged(self, timestamp: float, sensor: str, max_jump: float, max_delay: float) -> tuple[TimeVerdict, Clock]:
        """Judge a frame of `sensor` by its timestamp, s; frames up to `max_delay` s old are used."""
        before = self.sensor(sensor) or SensorClock(sensor, timestamp, self.elapsed)
        own = before.arrived(timestamp, self.elapsed - before.seen)
        limit = max(max_jump, 2 * self.step)
        right = (own,) if own.offset == 0 else (own, own.changed(offset=0.0))  # it may have been set right
        for tried in right:
            if self._agrees(tried, before, limit, max_delay):
                return "accepted", self._accepting(tried, max_jump)
        if (sensor, timestamp) in self.accepted or (before.doubt is not None and timestamp == before.stamp):
            far = abs(timestamp - own.offset - self.newest) > limit
            return "unconfirmed" if far else "late", self  # sent again: no second opinion
        d = min(max(before.step_to(timestamp), 0.0), before.step, QUIET / 4)
        elapsed = max(self.elapsed, before.seen + d)
        return self._doubting(own.changed(seen=elapsed), elapsed, limit, max_delay)

    def corrected(self, sensor: str, offset: float) -> Clock:
        """After the offset of a sensor's clock, s, has been estimated anew."""
        own = self.sensor(sensor)
        if own is None or own.offset == offset:
            return self
        moved = own.offset - offset
        time, doubt = (None if t is None else t + moved for t in (own.time, own.doubt))
        return self._with(own.changed(offset=offset, time=time, doubt=doubt, first=own.first + moved, lead=0.0))

    def _agrees(self, own: SensorClock, before: SensorClock, limit: float, max_delay: float) -> bool:
        """Return True if the latest frame of a sensor is in time and in consensus."""
        time = own.stamp - own.offset
        apart = time - self.newest
        if self.newest == -math.inf or -max_delay <= apart <= 0:
            return True
        if not -max_delay <= apart <= limit:
            return False
        others = [r for r in self.sensors if r.name != own.name and r.trusted and r.live(self.elapsed)]
        if not others:
            return True
        if self._leads(own, others, max_delay):
            return False
        against = total = 0.0
        for r in others:
            surprised = r.surprised(time, self.elapsed - r.seen, max_delay)
            if surprised or not r.slower(time, max_delay):
                against, total = against + surprised * r.record, total + r.record
        if not before.surprised(time, self.elapsed - before.seen, max_delay):
            total += own.record
        return 2 * against <= total

    def _leads(self, own: SensorClock, others: list[SensorClock], max_delay: float) -> bool:
        """Return True if the frames of a sensor have led those of most others by nearly `max_delay`."""
        if max_delay == 0 or own.kept < 1 / SMOOTHING:
            return False
        votes = [(r.lead, r.record) for r in others if r.kept >= 1 / SMOOTHING and r.doubt is None]
        return len(votes) > 1 and own.lead - weighted_median([*votes, (own.lead, own.record)]) > LEAD * max_delay

    def _accepting(self, own: SensorClock, max_jump: float) -> Clock:
        """After an accepted frame."""
        time = own.stamp - own.offset
        first = self.newest == -math.inf
        apart = 0.0 if first else time - self.newest
        elapsed = max(self.elapsed, self.reached + min(max(apart, 0.0), 2.5 * own.step or QUIET / 4))
        reached = elapsed if apart > 0 else self.reached
        own = own.changed(lead=0.0) if own.doubt is not None else own  # it has caught up
        behind = min(apart, 0.0)
        lead = own.lead + SMOOTHING * (behind - own.lead) if own.lead else behind
        own = own.changed(lead=lead, time=time, seen=elapsed, taken=elapsed, doubt=None, run=0)
        accepted = (*self.accepted, (own.name, own.stamp))[-REMEMBERED:]
        step = apart if apart > max_jump else 0.0
        newest = max(self.newest, time)
        return self._changed(newest=newest, accepted=accepted, step=step, elapsed=elapsed, reached=reached)._with(own)

    def _doubting(self, own: SensorClock, elapsed: float, limit: float, max_delay: float) -> tuple[TimeVerdict, Clock]:
        """After a frame that is left out, or with which the clock is set."""
        time = own.stamp - own.offset
        far = time > self.newest or self.newest - time > limit
        near = own.doubt is not None and abs(own.doubt - self.newest) <= limit
        agrees = self._supports(own, time, limit) if far else near
        backward = far or own.time is None or time < own.time or own.paced(time, elapsed, max_delay)
        run = (own.run if agrees else 0) + backward
        if own.doubt is None or not agrees:
            own = own.changed(first=time, taken=elapsed if own.time is None else own.taken)
        own = own.changed(run=run)
        with_it = [r for r in self._others(own, elapsed) if self._same(r, own, time, elapsed, max_delay)]
        enough = self._enough(own, with_it, elapsed, far, limit, max_delay)
        last = self.newest if own.doubt is None else own.doubt
        own = own.changed(doubt=time)
        if not enough:
            return "unconfirmed" if far else "late", self._changed(elapsed=elapsed)._with(own)
        verdict: TimeVerdict = (
            "set_back" if time < self.newest else "accepted" if time - self.newest <= limit else "set_ahead"
        )
        step = time - last if time - last > limit and time > self.newest and not with_it else 0.0
        return verdict, self._set(own, with_it, elapsed, step)

    def _others(self, own: SensorClock, elapsed: float) -> list[SensorClock]:
        """The other sensors that have a say: those that are live, and those that have only been left out so far."""
        others = [r for r in self.sensors if r.name != own.name]
        return [r for r in others if r.live(elapsed) or (r.step == 0 and r.doubt is not None)]

    def _enough(
        self,
        own: SensorClock,
        with_it: list[SensorClock],
        elapsed: float,
        far: bool,
        limit: float,
        max_delay: float,
    ) -> bool:
        """Return True if the clock is to be set to the latest time of a sensor, which some others support."""
        time, begins = own.stamp - own.offset, len(self.accepted) == 1
        against = [r for r in self._others(own, elapsed) if r.trusted and r not in with_it]
        # sensors of which nothing has come since are no evidence for the newest time
        going_on = [r for r in against if far or not r.with_time(time, elapsed, max_delay)]
        names = {name for name, _ in self.accepted}
        of_one = len(names) == 1 and names.isdisjoint(r.name for r in (own, *with_it))  # wrong from the start, maybe
        steady = [r for r in with_it if r.run > 1] if own.run > 1 and own.paced(time, elapsed, max_delay) else []
        for_it = with_it if of_one or (going_on and far) else [] if far else steady
        if for_it and own.record + sum(r.record for r in for_it) > sum(r.record for r in going_on):
            return True
        if going_on:
            return False
        if not far:
            return own.run >= RESET_AFTER and (own.time is None or time < own.time)
        if with_it and own.time is not None and (own.run > 1 or time - self.newest <= limit):
            return True
        return own.run >= (RESET_AFTER if own.time is None else 1 if begins else 2)

    def _set(self, own: SensorClock, with_it: list[SensorClock], elapsed: float, step: float) -> Clock:
        """After the clock was set to the time of a frame, which these other sensors support."""
        own = own.changed(time=own.doubt, taken=elapsed, doubt=None, run=0, lead=0.0)
        names = {r.name for r in with_it}
        sensors = []
        for r in self.sensors:
            time = r.doubt if r.name in names else None
            sensors.append(r.changed(time=time, taken=r.seen, doubt=None, run=0, lead=0.0))
        assert own.time is not None
        return Clock(own.time, ((own.name, own.stamp),), step, elapsed, elapsed, tuple(sensors))._with(own)

    def _same(self, r: SensorClock, own: SensorClock, time: float, elapsed: float, max_delay: float) -> bool:
        """Return True if the doubtful time of a sensor, s, is about this one of another."""
        if r.doubt is None:
            return False
        apart = time - r.doubt - (elapsed - r.seen)
        return abs(apart) <= max_delay + min(REGULAR * max(r.step, own.step), QUIET / 2)

    def _supports(self, own: SensorClock, time: float, limit: float) -> bool:
        """Return True if a time supports the doubtful one of its sensor: close to it, or the next of a slow stream of
        equal steps."""
        if own.doubt is None or self.newest - limit <= own.doubt <= self.newest:
            return False
        step = time - own.doubt
        return abs(step) <= limit or 0 < step <= 1.5 * (own.doubt - self.newest)

    def _changed(self, **values: Any) -> Clock:
        """With other values of some attributes."""
        return unchecked(Clock, **vars(self) | values)

    def _with(self, own: SensorClock) -> Clock:
        """With the clock of a sensor in place of the one before."""
        if any(r.name == own.name for r in self.sensors):
            return self._changed(sensors=tuple(own if r.name == own.name else r for r in self.sensors))
        kept = self.sensors
        if len(kept) >= MANY_SENSORS:
            least = min(kept, key=lambda r: (r.kept, r.seen))
            kept = tuple(r for r in kept if r is not least)
        return self._changed(sensors=(*kept, own))


def weighted_median(votes: Iterable[tuple[float, float]]) -> float:
    """The value up to which half of the weights lie, of (value, weight) pairs; in a tie the one of the smaller size."""
    ordered = sorted(votes)
    half, total = sum(weight for _, weight in ordered) / 2, 0.0
    for k, (value, weight) in enumerate(ordered):
        total += weight
        if total > half * (1 + 1e-9):
            return value
        if total >= half * (1 - 1e-9):
            return min(value, ordered[k + 1][0], key=abs)
    return ordered[-1][0]
