"""The clock of a tracker: whether a frame is in time or too late, and whether the clock itself was set.

One frame with a broken timestamp must not take the tracker to another century, from where all later frames would be
late; and a clock that was set must not stop the tracking. With `apart` the time of a frame less the newest time:

    -max_delay <= apart <= max_jump   accepted
    |apart| > max_jump                unconfirmed: left out, until a second frame of about that time confirms it
    else                              late: left out

With a single earlier frame it is unknown which of two times of a sensor is wrong, and the second is taken. A stream
whose steps are longer than `max_jump` is recognised by two equal steps, and then has its own limit.

A sensor whose own frames go back in time, `reset_after` new ones in a row, has had its clock set back; the tracker
follows. Late frames of other sensors, in a burst after a stall for instance, and frames that are sent again are no
evidence on the clock. A sensor that was never in time, since its own clock is wrong, confirms a jump only by
`reset_after` frames in a row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from saga_fg.settings import PositiveInt, PositiveOrInf, Settings, setting

REMEMBERED = 200  # accepted frames, by which sensors and repeated frames are recognised

TimeVerdict = Literal["accepted", "late", "unconfirmed", "set_ahead", "set_back"]
"""Verdict on the time of a frame: late and unconfirmed frames are left out, others used; with set_ahead and set_back
the clock was first set to the frame's time."""
Stamp = tuple[str, float]
"""Sensor and time of a frame, s."""


@dataclass(frozen=True)
class ClockSettings(Settings):
    """Handling of implausible timestamps."""

    max_jump: PositiveOrInf = setting(
        10.0, "leave out a frame further than this from the newest until a second confirms its time, s; usual 2 to 30"
    )
    reset_after: PositiveInt = setting(
        3, "set the clock back after this many frames in a row in which the time of a sensor decreases; usual 2 to 10"
    )


@dataclass(frozen=True)
class Clock:
    """The newest time, s, and the evidence for another one. A value: `judged` returns the clock after a frame.

    newest       of the frames accepted, -inf before the first
    accepted     the latest of them, since the clock was set
    step         the latest step of a slow stream, 0 of others, s
    doubtful     the latest frame that was left out, None if there is none since the latest accepted one
    run          frames in a row that support the time of that one
    """

    newest: float = -math.inf
    accepted: tuple[Stamp, ...] = ()
    step: float = 0.0
    doubtful: Stamp | None = None
    run: int = 0

    def judged(
        self, timestamp: float, sensor: str, settings: ClockSettings, max_delay: float
    ) -> tuple[TimeVerdict, Clock]:
        """Judge a frame of `sensor` by its time, s; frames up to `max_delay` s old are used."""
        apart, max_jump = timestamp - self.newest, max(settings.max_jump, 2 * self.step)
        if -max_delay <= apart <= max_jump or self.newest == -math.inf:
            return "accepted", self._with(timestamp, sensor, apart if settings.max_jump < apart < math.inf else 0.0)
        far, stamp = abs(apart) > max_jump, (sensor, timestamp)
        if stamp == self.doubtful or stamp in self.accepted:  # sent again: no second opinion
            return "unconfirmed" if far else "late", self
        own = [time for name, time in self.accepted if name == sensor]
        before = self.run if self._doubts_far(max_jump) == far else 0
        if far:
            run = before + 1 if self._agrees(timestamp, max_jump) else 1
            needed = settings.reset_after if not own else 1 if len(self.accepted) == 1 else 2
        else:
            run = before + (bool(own) and timestamp < max(own))
            needed = settings.reset_after
        if run < needed:
            return "unconfirmed" if far else "late", replace(self, doubtful=stamp, run=run)
        last = self.newest if self.doubtful is None else self.doubtful[1]
        step = timestamp - last if timestamp - last > max_jump else 0.0
        return "set_ahead" if apart > 0 else "set_back", Clock()._with(timestamp, sensor, step)

    def _with(self, timestamp: float, sensor: str, step: float) -> Clock:
        """After an accepted frame."""
        accepted = (*self.accepted, (sensor, timestamp))[-REMEMBERED:]
        return Clock(max(self.newest, timestamp), accepted, step)

    def _doubts_far(self, max_jump: float) -> bool:
        """Return True if the doubtful frame is further away than `max_jump`."""
        return self.doubtful is not None and abs(self.doubtful[1] - self.newest) > max_jump

    def _agrees(self, timestamp: float, max_jump: float) -> bool:
        """Return True if a time supports the doubtful one: close to it, or the next of a slow stream of equal steps."""
        if self.doubtful is None or not self._doubts_far(max_jump):
            return False
        step = timestamp - self.doubtful[1]
        return abs(step) <= max_jump or 0 < step <= 1.5 * (self.doubtful[1] - self.newest)
