"""Who is who from one stretch of a recording to the next: an object is what its tracklets are.

Every stretch joins tracklets into objects anew, and calls an object by the first tracklet it sees of it. What was part
of an object before stays so: the object keeps the name that its tracklets have. Where they have several, it is that of
the tracklet that reaches furthest towards the stretch, for what goes on across the boundary must not change its name.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray


class Identities:
    """The lasting names of objects. joined: tracklets so far that became part of another's object."""

    def __init__(self) -> None:
        self.joined = 0
        self._owner: dict[int, tuple[int, float]] = {}  # of a tracklet: its object's name, and when it was last used

    def name(
        self, ids: IntArray, object_of: IntArray, track_of: IntArray, times: FloatArray, span: tuple[float, float]
    ) -> dict[int, int]:
        """The name of each of some objects (n,), ascending, in a stretch [begin, end), s, that may be infinite.

        No two have the same: one whose names are all taken has that of another which needs its own no more.

        object_of, track_of (N,): of its detections in order of time, -1 for none; times (N,), s
        """
        begin, end = span
        rows = np.flatnonzero((track_of >= 0) & np.isin(object_of, ids))
        pairs = np.unique(np.stack([object_of[rows], track_of[rows]], axis=1), axis=0)
        tracklets, begins = np.unique(track_of[rows], return_index=True)
        first = dict(zip(tracklets.tolist(), times[rows[begins]].tolist(), strict=True))
        names: dict[int, int] = {}
        for id_ in ids.tolist():
            tracks = self._in_order(pairs[pairs[:, 0] == id_, 1].tolist(), first, begin)
            known = [self._owner[track][0] for track in tracks if track in self._owner]
            taken = set(names.values())
            names[id_] = next(name for name in (*known, id_, *ids.tolist()) if name not in taken)
            for k, track in enumerate(tracks):
                if k == 0 or first[track] < end:
                    self.joined += track != names[id_] and track not in self._owner
                    self._owner[track] = (names[id_], begin)
        return names

    def forget(self, before: float) -> None:
        """Forget tracklets of stretches that begin before a time, s."""
        self._owner = {track: owner for track, owner in self._owner.items() if owner[1] >= before}

    @staticmethod
    def _in_order(tracks: Sequence[int], first: dict[int, float], begin: float) -> list[int]:
        """Those that were there before a stretch, the latest first; then those that begin in it, the first first."""
        old = sorted((track for track in tracks if first[track] < begin), key=lambda track: -first[track])
        return old + sorted((track for track in tracks if first[track] >= begin), key=lambda track: first[track])
