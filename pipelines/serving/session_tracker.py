"""What a stream needs of its tracker."""

from __future__ import annotations

from typing import Any, Protocol

from pipelines.tracking import OnlineTracker
from saga_fg.tracking import TimeVerdict


class SessionTracker(OnlineTracker, Protocol):
    """A tracker that keeps time, and whose state can be kept: `Tracker` and `GreedyTracker` of `saga_fg`."""

    @property
    def time_verdict(self) -> TimeVerdict:
        """What it made of the latest frame's time."""
        ...

    @property
    def max_jump(self) -> float:
        """A frame further than this from the newest one has to be confirmed by another, s."""
        ...

    def snapshot(self) -> Any:
        """All that the tracker knows, as a tree of values."""
        ...

    def restore(self, snapshot: Any) -> None:
        """Go on from a snapshot of a tracker of the same settings."""
        ...
