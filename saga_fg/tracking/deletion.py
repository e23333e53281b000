"""Delete: tracks without detections whose place is no longer known, and those that are not likely to exist.

A track lives on while its place is known to `max_deviation`, as it is then reported, or while it could be re-linked,
at most for `max_coasting`. Neighbours that are still detected keep its place known for longer. Deleted tracks are
marginalised, so that their information on their neighbours stays.
"""

from __future__ import annotations

import logging

import numpy as np

from saga_fg.numerics.arrays import BoolArray
from saga_fg.tracking.relinking import relinkable
from saga_fg.tracking.reporting import known_places
from saga_fg.tracking.tracker_state import TrackerState

log = logging.getLogger(__name__)


def delete_tracks(state: TrackerState) -> None:
    """Delete the tracks that have come to their end at the state's time."""
    table, settings = state.table, state.settings
    detected = np.zeros(len(table), dtype=bool)
    detected[table.rows(state.assignment.id)] = True  # perhaps by a late frame
    deleted = ~(detected | known_places(state) | relinkable(state))
    deleted |= table.coasting(state.time) > settings.max_coasting
    deleted |= ~table.confirmed & (table.existence < settings.existence.delete_below)
    deleted |= untrackable(state)
    state.remove(deleted)


def untrackable(state: TrackerState) -> BoolArray:
    """(n,) tracks whose states are out of bounds."""
    deleted = ~state.kinematics().within_limits(state.origin)
    if deleted.any():
        log.warning("deleted, since their states are out of bounds: tracks %s", state.table.id[deleted].tolist())
    return deleted
