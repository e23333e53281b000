"""The table of tracks: one row a track, one column an attribute, all that is known of tracks besides the joint state.

The joint state (`saga_fg.tracking.joint_state`) is kept by id, since tracks are correlated in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.columns import Columns
from saga_fg.tracking.box_filter import BoxFilter
from saga_fg.tracking.sensor_evidence import SensorEvidence
from saga_fg.tracking.stationarity import Stationarity
from saga_fg.tracking.turn_rate import TurnRate
from saga_fg.types.boxes import Boxes


@dataclass(eq=False)
class TrackTable(Columns):
    """n tracks, in order of initiation. Times in s on the tracker's clock.

    id                (n,)
    label             (n,) class
    existence         (n,) probability that the track is a real object
    last_existence    (n,) its existence at its latest detection
    score             (n,) probability of its latest detection
    best_score        (n,) the highest of its detections
    covariance_scale  (n,) factor on the reported standard deviation of the position, see `saga_fg.tracking.reporting`
    position_bias     (n,) standard deviation of the position error that all its detections share, m
    initiated         (n,) time of its first detection
    last_detected     (n,) time of its latest detection
    last_in_view      (n,) time when it was last inside a sensor's field of view
    confirmed         (n,) whether misses no longer delete it
    has_moved         (n,) whether it was ever clearly in motion
    opportunities     (n,) frames in which its best sensor could have detected it
    hits              (n,) frames in which that sensor detected it
    required_hits     (n,) detections after which it is no longer tentative, if they are of one sensor
    unresolved        (n,) further frames to tell it from the track that it overlaps, see `saga_fg.tracking.unresolved`
    class_belief      (n, C) probabilities of the classes that detectors mistake for each other
    box               size, height and heading
    stationarity      probability and place of standing still
    turn              turn rate
    sensors           latest evidence of each sensor
    """

    id: IntArray
    label: StrArray
    existence: FloatArray
    last_existence: FloatArray
    score: FloatArray
    best_score: FloatArray
    covariance_scale: FloatArray
    position_bias: FloatArray
    initiated: FloatArray
    last_detected: FloatArray
    last_in_view: FloatArray
    confirmed: BoolArray
    has_moved: BoolArray
    opportunities: FloatArray
    hits: FloatArray
    required_hits: FloatArray
    unresolved: FloatArray
    class_belief: FloatArray
    box: BoxFilter
    stationarity: Stationarity
    turn: TurnRate
    sensors: SensorEvidence

    @classmethod
    def empty(cls, classes: int = 0) -> Self:
        """A table without tracks; `classes`: C."""
        number, truth = np.empty(0), np.empty(0, dtype=bool)
        return cls(
            np.empty(0, dtype=np.int64),
            np.empty(0, dtype="<U1"),
            *(number,) * 9,
            *(truth,) * 2,
            *(number,) * 4,
            np.empty((0, classes)),
            BoxFilter.empty(),
            Stationarity.empty(),
            TurnRate.empty(),
            SensorEvidence.empty(),
        )

    def snapshot(self) -> Self:
        """A copy that shares no array with this table that can be written."""
        return self.copied()

    def rows(self, ids: IntArray) -> IntArray:
        """Rows (k,) of tracks that are in the table."""
        return np.searchsorted(self.id, ids)  # ids count up

    @property
    def tentative(self) -> BoolArray:
        """(n,) tracks that may be no object of their own: of too few detections, or unresolved."""
        return np.asarray((self.unresolved > 0) | ~self.sensors.confirmed(self.required_hits))

    def coasting(self, now: float) -> FloatArray:
        """(n,) time since the latest detection, s, rounded to the microsecond."""
        return np.maximum(_rounded(now - self.last_detected), 0.0)

    def out_of_view(self, now: float) -> FloatArray:
        """(n,) time since it was last in a sensor's field of view, s, rounded to the microsecond."""
        return _rounded(now - self.last_in_view)

    def boxes(self, position: FloatArray, velocity: FloatArray) -> Boxes:
        """The boxes of all tracks at positions (n, 2), world, with velocities (n, 2), which are not checked."""
        centre = np.concatenate([position, self.box.z[:, None]], axis=1)
        return Boxes.unchecked(self.label, centre, self.box.size, self.box.yaw, velocity)


def _rounded(seconds: FloatArray) -> FloatArray:
    """Times (n,), s, to the microsecond: as by `round`, in half the time."""
    return np.asarray(np.rint(seconds * 1e6) / 1e6)
