"""The graph-aware tracker: frames in, tracks out, whatever comes.

One frame of one sensor at a time, from any sensor at any time. With no edge rules it is the classical tracker of
independent Kalman filters, by the same code. What a frame does to the tracks is in `saga_fg.tracking.track_set`; here
is what a tracker promises: time is kept, and a step is taken whole or not at all.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider, ProviderError, SceneFactorGraph, UndeterminedError
from saga_fg.model.edge_rules import EdgeRule
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.assignment import Assignment
from saga_fg.tracking.clock import Clock, TimeVerdict
from saga_fg.tracking.observer import Observer
from saga_fg.tracking.provider_names import new_provider
from saga_fg.tracking.roadside import Roadside
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.tracking.snapshot import Snapshot
from saga_fg.tracking.track_set import TrackSet
from saga_fg.types.by_class import class_settings
from saga_fg.types.frame import LATEST, Frame, finite_seconds
from saga_fg.types.sensor import Sensor, sensor_model
from saga_fg.types.track import Tracks

log = logging.getLogger(__name__)


class Tracker:
    """Tracks all objects of one scene. `step(frame)` takes a frame of any sensor and returns the tracks at its time.

    settings  the tracker's settings
    sensors   models by sensor name; the entry named "default" serves all others
    rules     edge rules, in place of `settings.edges`
    observer  is told how things stand at the end of every stage
    providers add factors of your own to the running graph of the tracks, once a frame (`saga_fg.graph`)

    A frame older than the newest one by up to `max_delay` is used: the fixed-lag estimator puts its measurements where
    they belong, a filter moves them to the present along the objects' own motion, and so does any estimator with
    `providers` or where objects move nonlinearly. An older one is left out and counted in `late_frames`; so is,
    uncounted, one from another time until a second one confirms that the clock was set.
    `time_verdict` tells of the latest frame (see `saga_fg.tracking.clock`).

    A tracker can be pickled and copied; its copies have no observer.
    """

    def __init__(
        self,
        settings: TrackerSettings | None = None,
        sensors: Mapping[str, Sensor] | None = None,
        rules: tuple[EdgeRule, ...] | None = None,
        observer: Observer | None = None,
        providers: Sequence[FactorProvider] = (),
    ) -> None:
        self.settings = settings or TrackerSettings()
        self.sensors = dict(sensors or {})
        self.rules: tuple[EdgeRule, ...] = self.settings.edges if rules is None else rules
        self.late_frames = 0
        self.assignment = Assignment.empty()  # of the latest frame
        self.time_verdict: TimeVerdict = "accepted"  # of the latest frame
        self._clock = Clock()
        self._clock_settings = replace(self.settings.clock, max_jump=self.max_jump)
        self.providers = tuple(providers) or tuple(new_provider(name) for name in self.settings.providers)
        self._tracks = TrackSet(self.settings, self.rules, observer, self.providers)
        self._failed = False  # the latest step

    def step(self, frame: Frame) -> Tracks:
        """Take in one frame and return all reported tracks, in world coordinates, at the newest time seen so far.

        Raises `InputError` for a frame that can't be used. Whatever is raised, the tracker is as it was before. Where
        the next frame fails as well, and would not without the tracks, these are deleted and it is taken in; what a
        provider does wrong is raised every time.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"frame: expected a Frame, got {type(frame).__name__}")
        tracks = self._tracks
        try:
            reported = self._step(frame, tracks.copied())
        except BaseException as error:
            if self.providers and isinstance(error, ProviderError | UndeterminedError):  # tracks are not to blame
                raise
            again, self._failed = self._failed, isinstance(error, Exception)
            if not (again and self._failed and len(tracks)):
                raise
            bare = tracks.copied()
            bare.forget()
            reported = self._step(frame, bare)  # unless it is the frame that can't be used
            log.warning("tracks %s are deleted, they can't go on: %s", tracks.ids, error)
        self._failed = False
        return reported

    def tracks(self, timestamp: float) -> Tracks:
        """The tracks predicted to `timestamp` (s), without taking anything in; the present ones for an earlier time.

        Left out are tracks that can't be predicted that far. Raises `InputError` for a timestamp that is not finite.
        """
        timestamp = finite_seconds(timestamp)
        newest = self._clock.newest
        if newest == -math.inf:
            return Tracks.empty(timestamp)
        if timestamp <= newest:
            return self._tracks.report(timestamp)
        ahead = self._tracks.copied()
        ahead.predict(ahead.relative(min(timestamp, newest + LATEST)))
        return ahead.report(timestamp)

    def snapshot(self) -> Snapshot:
        """All that the tracker knows, as a value."""
        return Snapshot(self._tracks.snapshot(), self._clock, self.time_verdict, self.late_frames, self.assignment)

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from where a tracker of the same settings was; as often as wanted from one snapshot."""
        self._tracks.restore(snapshot.tracks)
        self._clock, self.time_verdict = snapshot.clock, snapshot.time_verdict
        self.late_frames, self.assignment = snapshot.late_frames, snapshot.assignment

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), (self.settings, self.sensors, self.rules, None, self.providers), self.snapshot())

    def sensor(self, name: str) -> Sensor:
        """The model of a sensor."""
        return sensor_model(self.sensors, name)

    def class_settings(self, label: str) -> ClassSettings:
        """The settings of a class."""
        return class_settings(self.settings.classes, ClassSettings, label)

    @property
    def graph(self) -> SceneGraph | None:
        """The scene graph of the latest interval."""
        return self._tracks.graph

    @property
    def world_T_ego(self) -> FloatArray | None:
        """The vehicle's pose (4, 4) as factor providers and the objects have it; None where it is not estimated."""
        return self._tracks.world_T_ego

    @property
    def running_graph(self) -> SceneFactorGraph:
        """The factor graph of the estimator: variables, factors, values; with `providers` the one that runs."""
        return self._tracks.running_graph

    @property
    def roadside(self) -> Roadside:
        """What is known of the road."""
        return self._tracks.roadside

    @property
    def max_jump(self) -> float:
        """How far from the newest frame another has to be confirmed, s: a gap that tracks can outlive is no jump."""
        lives = [c.max_coasting for c in self.settings.classes.values() if math.isfinite(c.max_coasting)]
        return max(self.settings.clock.max_jump, *lives, 0.0)

    @property
    def max_delay(self) -> float:
        """How late a frame may come and still be used, s."""
        settings = self.settings
        if settings.ego is not None and settings.ego.estimated:
            return 0.0  # nobody knows where the vehicle was
        return max(settings.max_delay, self._tracks.window)

    def _step(self, frame: Frame, tracks: TrackSet) -> Tracks:
        """Take a frame in, into these tracks, or leave everything as it was."""
        unchanged = self._tracks, self._clock, self.time_verdict
        self._tracks = tracks
        try:
            sensor = self.sensor(frame.sensor)
            timestamp = frame.timestamp + sensor.time_offset
            used = self._keep_time(timestamp, frame.sensor)
            self.assignment = tracks.take_in(frame, sensor, timestamp) if used else Assignment.empty()
            return tracks.report(self._clock.newest)
        except BaseException:
            self._tracks, self._clock, self.time_verdict = unchanged
            raise

    def _keep_time(self, timestamp: float, sensor: str) -> bool:
        """Whether a frame is to be used; where the clock was set, the tracks are prepared for it."""
        before = self._clock.newest
        self.time_verdict, self._clock = self._clock.judged(timestamp, sensor, self._clock_settings, self.max_delay)
        if self.time_verdict in ("late", "unconfirmed"):
            self.late_frames += self.time_verdict == "late"
            text = "frame of %s at %.3f s is left out: %s, %+.3f s from the newest one"
            log.warning(text, sensor, timestamp, self.time_verdict, timestamp - before)
            return False
        if before == -math.inf or self.time_verdict == "set_back":
            self._tracks.restart(timestamp)
        elif self.time_verdict == "set_ahead":
            self._tracks.outlive(timestamp)
        if self.time_verdict != "accepted":
            log.warning("the clock was set from %.3f s to %.3f s by %s", before, timestamp, sensor)
        return True


def _restored(kind: type[Tracker], arguments: tuple[Any, ...], snapshot: Snapshot) -> Tracker:
    tracker = kind(*arguments)
    tracker.restore(snapshot)
    return tracker
