"""Delete: tracks that are no longer detected, visible or likely to exist, nor likely to be found again.

Deleted tracks are marginalised, so that their information on their neighbours stays.
"""

from __future__ import annotations

import logging

from saga_fg.numerics.arrays import BoolArray
from saga_fg.tracking.relinking import relinkable
from saga_fg.tracking.tracker_state import TrackerState

log = logging.getLogger(__name__)


def delete_tracks(state: TrackerState) -> None:
    """Delete the tracks that have come to their end at the state's time."""
    table, settings = state.table, state.settings
    (max_coasting,) = state.class_values(table.label, "max_coasting")
    deleted = table.coasting(state.time) > max_coasting
    deleted |= table.out_of_view(state.time) > settings.max_out_of_view
    deleted &= ~(relinkable(state) & (table.hits >= settings.confirming_detections))
    deleted |= ~table.confirmed & (table.existence < settings.existence.delete_below)
    deleted |= untrackable(state)
    state.remove(deleted)


def untrackable(state: TrackerState) -> BoolArray:
    """(n,) tracks whose states are out of bounds."""
    deleted = ~state.kinematics().within_limits(state.origin)
    if deleted.any():
        log.warning("deleted, since their states are out of bounds: tracks %s", state.table.id[deleted].tolist())
    return deleted
