"""A tracker's run judged on the gaps of a recording.

Labels and tracks that were detected at the moment are matched one to one (`data_tools.metrics.matching`). An object is
*held* by the track it was matched to last, at most `SETTLING` s ago.

kept      the track that holds the object `SETTLING` s after the gap is the one that held it before
error     distance of that track, while it is not detected, to the label, m; `CAP` where it is not known or farther away
link      a track that is detected again after `SHORTEST` s or more; it is right if it holds the object it held before,
          false if it holds another, unknown if it holds none before or after
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from data_tools.metrics.consistency import nees, negative_log_density
from data_tools.metrics.matching import match_scene
from saga_fg.learning.gaps import LONGEST, SHORTEST, Gap, reached
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.track import Tracks

SETTLING = 0.6  # s: for so long a returning object may wait for its identity
DETECTED = 0.15  # s: a track counts as detected for so long, as sensors don't measure at the moments of labels
CAP = 10.0  # m
GATE = 2.0  # m, between a label and its track

A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class Prediction:
    """A track without detections against the label of its object.

    error   m, however large;  nees: its square by the covariance of the position, chi-squared with 2 degrees of freedom
    nll     negative logarithm of the density of the true position, nats;  NaN, as nees, without a covariance
    """

    error: float
    nees: float
    nll: float


@dataclass(frozen=True)
class GapOutcome:
    """The outcome of one gap of an object.

    held, kept   whether a track had it before, and whether that track has it after; kept: None without tracks
    reported     whether that track is among the results at the last moment of the gap; None without tracks
    error        mean over the gap, m
    at           error at the end of each length that the gap reaches, m
    predicted    where the track that had it is, at these moments, if it is among the results
    """

    held: bool
    kept: bool | None
    reported: bool | None
    error: float
    at: Mapping[float, float]
    predicted: Mapping[float, Prediction]


@dataclass(frozen=True)
class Links:
    """Tracks that were detected again after a gap, by whom they hold."""

    right: int = 0
    false: int = 0
    unknown: int = 0


class JudgedRun:
    """A run's tracks (K,) at the moments of a labelled scene.

    extrapolated  whether a track that is not reported is taken to move on as it was last reported
    """

    def __init__(self, labelled: LabelledScene, tracks: Sequence[Tracks], extrapolated: bool = False) -> None:
        self._labelled, self.tracks, self._extrapolated = labelled, tracks, extrapolated
        truth = labelled.scene.ground_truth
        assert truth is not None
        detected = [found.select(found.coasting <= DETECTED) for found in tracks]
        self._track_of: list[dict[str, int]] = []
        self._object_of: list[dict[int, str]] = []
        for moment, found, match in zip(truth, detected, match_scene(truth, detected, GATE), strict=True):
            pairs = (moment.id[match.object_row].tolist(), found.id[match.track_row].tolist())
            self._track_of.append(dict(zip(*pairs, strict=True)))
            self._object_of.append(dict(zip(*pairs[::-1], strict=True)))
        self._detected = [set(found.id.tolist()) for found in detected]
        self._row_of = [{name: row for row, name in enumerate(found.id.tolist())} for found in tracks]

    def outcome(self, gap: Gap) -> GapOutcome:
        """Judge one gap."""
        name, ends = str(self._labelled.id[gap.row]), reached(self._labelled.scene.timestamps, gap)
        before = self._last(self._track_of, name, gap.start, back=True)
        after = self._last(self._track_of, name, gap.stop, back=False)
        if before is None:
            return GapOutcome(False, False, False, CAP, dict.fromkeys(ends, CAP), {})
        moments = range(gap.start + 1, gap.stop)
        errors = np.array([self._error(before, gap.row, k) for k in moments])
        reported = before in self._row_of[gap.stop - 1]
        at = {length: float(errors[k - gap.start - 1]) for length, k in ends.items()}
        known = errors[np.isfinite(errors)]
        mean = float(known.mean()) if len(known) else float("nan")
        predicted = {h: found for h, k in ends.items() if (found := self._prediction(before, gap.row, k)) is not None}
        at = {h: e for h, e in at.items() if np.isfinite(e)}
        return GapOutcome(True, after == before, reported, mean, at, predicted)

    def holders(self, gap: Gap) -> list[int | None]:
        """The detected track of the object of a gap at each moment, None where there is none."""
        name = str(self._labelled.id[gap.row])
        return [found.get(name) for found in self._track_of]

    def links(self) -> Links:
        """Judge all tracks that were detected again."""
        time = self._labelled.scene.timestamps
        latest: dict[int, int] = {}
        right = false = unknown = 0
        for k, detected in enumerate(self._detected):
            for track in detected:
                since = latest.get(track)
                latest[track] = k
                if since is None or not SHORTEST - 1e-6 <= time[k] - time[since] <= LONGEST + 1e-6:
                    continue
                before = self._last(self._object_of, track, since, back=True)
                after = self._last(self._object_of, track, k, back=False)
                if before is None or after is None:
                    unknown += 1
                elif before == after:
                    right += 1
                else:
                    false += 1
        return Links(right, false, unknown)

    def _last(self, of: Sequence[Mapping[A, B]], one: A, moment: int, back: bool) -> B | None:
        """The last partner within `SETTLING` s until a moment (`back`), or from it on."""
        after = (self._labelled.scene.timestamps - self._labelled.scene.timestamps[moment]) * (-1 if back else 1)
        near = np.flatnonzero((after >= 0) & (after <= SETTLING))
        return next((of[k][one] for k in near[::-1].tolist() if one in of[k]), None)

    def _error(self, track: int, row: int, moment: int) -> float:
        """The error of a track at a moment, NaN where the object is not labelled."""
        truth = self._labelled.position[moment, row]
        if not np.isfinite(truth[0]):
            return float("nan")
        there = self._position(track, moment)
        return CAP if there is None else min(float(np.hypot(*(there - truth))), CAP)

    def _prediction(self, track: int, row: int, moment: int) -> Prediction | None:
        truth, at = self._labelled.position[moment, row], self._row_of[moment].get(track)
        if at is None or not np.isfinite(truth[0]):
            return None
        error = self.tracks[moment].boxes.position[at, :2] - truth
        covariance = self.tracks[moment].position_covariance[at]
        squared = nees(error[None], covariance[None])
        nll = negative_log_density(squared, covariance[None])
        return Prediction(float(np.hypot(*error)), float(squared[0]), float(nll[0]))

    def _position(self, track: int, moment: int) -> FloatArray | None:
        for k in range(moment, -1, -1):
            row = self._row_of[k].get(track)
            if row is not None:
                found = self.tracks[k]
                elapsed = float(self.tracks[moment].timestamp - found.timestamp)
                return np.asarray(found.boxes.position[row, :2] + elapsed * found.boxes.velocity[row])
            if not self._extrapolated:
                return None
        return None
