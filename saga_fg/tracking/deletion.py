"""Delete: tracks that are no longer detected, visible or likely to exist, or that follow another track's object.

Deleted tracks are marginalised, so that their information on their neighbours stays.
"""

from __future__ import annotations

import logging

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray
from saga_fg.tracking.tracker_state import TrackerState

log = logging.getLogger(__name__)


def delete_tracks(state: TrackerState) -> None:
    """Delete the tracks that have come to their end at the state's time."""
    table, settings = state.table, state.settings
    coasting = table.coasting(state.time)
    max_coasting, merging = state.class_values(table.label, "max_coasting", "merge_distance")
    deleted = coasting > max_coasting
    deleted |= np.round(state.time - table.last_in_view, 6) > settings.max_out_of_view
    deleted |= ~table.confirmed & (table.existence < settings.existence.delete_below)
    deleted |= untrackable(state)
    if (merging > 0).any():
        deleted |= duplicate_tracks(state.kinematics().position, table.label, coasting <= 0, merging)
    state.remove(deleted)


def untrackable(state: TrackerState) -> BoolArray:
    """(n,) tracks whose states are out of bounds."""
    deleted = ~state.kinematics().within_limits(state.origin)
    if deleted.any():
        log.warning("deleted, since their states are out of bounds: tracks %s", state.table.id[deleted].tolist())
    return deleted


def duplicate_tracks(position: FloatArray, label: StrArray, detected: BoolArray, distance: FloatArray) -> BoolArray:
    """(n,) coasting tracks closer than their `distance` (n,), m, to a detected track of their class.

    position (n, 2), label (n,), detected (n,) in the latest frame. Two tracks that are both detected in a frame are two
    objects, since measurements hold no duplicates; of two of which one is detected, the other is most often the same.
    """
    result = np.zeros(len(label), dtype=bool)
    coasting, there = np.flatnonzero(~detected & (distance > 0)), np.flatnonzero(detected)
    apart = np.hypot(*np.moveaxis(position[coasting, None] - position[there], -1, 0))
    same = (apart < distance[coasting, None]) & (label[coasting, None] == label[there])
    result[coasting[same.any(axis=1)]] = True
    return result
