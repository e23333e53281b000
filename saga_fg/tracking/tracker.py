"""The graph-aware tracker: one frame of one sensor at a time, from any sensor at any time.

    predict (prediction) -> measure (measurements, map_nodes, update) -> associate (association, relinking)
    -> follow encounters (update, identities) -> update (update; edges: prediction) -> existence (update, track_life)
    -> hand over (relinking) -> initiate (track_life) -> exchange identities (update) -> delete, report (track_life)

(figure 2 of Sani and Anand, arXiv 2411.03702), in brackets the modules of each stage. Without edge rules this is the
classical tracker of independent Kalman filters, by the same code.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from traceback import walk_tb
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, SagaError, require_type
from saga_fg.graph import FactorProvider, ProviderError, SceneFactorGraph, UndeterminedError
from saga_fg.model import SceneGraph, Sensor, checked_sensors, sensor_model
from saga_fg.numerics import Assignment, FloatArray, IntArray, StrArray
from saga_fg.parts import KINDS, in_one_line, new_part, part_name
from saga_fg.tracking.association import associate
from saga_fg.tracking.by_name import estimator_name
from saga_fg.tracking.clock import TimeVerdict
from saga_fg.tracking.clock_offsets import SensorTime, compared, sensor_times
from saga_fg.tracking.journal import Observer, Stage, TrackerView
from saga_fg.tracking.map_nodes import MapNodes
from saga_fg.tracking.measurements import frame_measurements
from saga_fg.tracking.prediction import judge_edges, look_ahead, predict_state
from saga_fg.tracking.relinking import hand_over
from saga_fg.tracking.sensor_noise import UNMEASURED, SensorNoise, for_gates, noise_after, with_found_noise
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.track_life import delete_tracks, initiate_tracks, report_tracks, resolve_tracks
from saga_fg.tracking.tracker_state import TrackerSnapshot, TrackerState
from saga_fg.tracking.update import (
    exchange_identities,
    follow_encounters,
    infer_signals,
    look,
    update_existence,
    update_tracks,
)
from saga_fg.types import (
    LATEST,
    LONGEST_PREDICTION,
    Frame,
    PredictedTracks,
    Tracks,
    checked_horizons,
    finite_seconds,
    within_reach,
)

log = logging.getLogger(__name__)


class Tracker:
    """Tracks all objects of one scene. `step(frame)` takes a frame of any sensor and returns the tracks at its time.

    settings  the tracker's settings
    sensors   models by sensor name; the entry named "default" serves all others
    observer  is notified at the end of every step of a frame
    providers add factors of your own to the running graph of the tracks, once a frame (`saga_fg.graph`)

    A frame older than the newest one by up to `max_delay` is used: the fixed-lag estimator puts its measurements at
    their own time, a filter moves them to the present along the objects' own motion, and so does any estimator with
    `providers` or where objects move nonlinearly. An older one is left out and counted in `late_frames`; so is,
    uncounted, one far from the newest time until a second one confirms that the clock was set.

    The methods `kf` and `centerpoint` of the command come from `load_config(family).new_tracker(method)` of
    `pipelines.config`.

    A tracker can be pickled and copied; its copies have no observer.
    """

    def __init__(
        self,
        settings: TrackerSettings | None = None,
        sensors: Mapping[str, Sensor] | None = None,
        observer: Observer | None = None,
        providers: Sequence[FactorProvider] = (),
    ) -> None:
        self.settings = TrackerSettings() if settings is None else settings
        require_type("settings", self.settings, TrackerSettings)
        self.sensors = checked_sensors(sensors)
        self.observer = observer
        for provider in providers:
            KINDS[FactorProvider].require("providers", provider)
        named = (new_part("providers", given, FactorProvider) for given in self.settings.providers)
        self.providers = tuple(providers) or tuple(named)
        self._state = TrackerState(self.settings, self.providers, self.sensors)
        self._last_step_failed = False

    def __repr__(self) -> str:
        """The number of tracks, and the settings that differ from the defaults."""
        sensors = ", ".join(self.sensors) or "by the defaults"
        usual = TrackerSettings()
        named = [item.name for item in fields(self.settings) if item.name not in ("estimator", "edges")]
        changed = [name for name in named if getattr(self.settings, name) != getattr(usual, name)]
        state = self._state
        at = f" at {state.clock.newest:.3f} s" if len(state.table) else ""
        return (
            f"Tracker({len(state.table)} tracks{at}; estimator {estimator_name(self.settings.estimator)}, "
            f"{len(self.settings.edges)} edge rules, sensors {sensors}; changed: {', '.join(changed) or 'nothing'})"
        )

    def step(self, frame: Frame) -> Tracks:
        """Take in one frame and return all reported tracks, in world coordinates, at the newest time seen so far.

        Raises `InputError` for a frame that can't be used. Whatever is raised, the tracker is as it was before. Where
        the next frame fails as well, and would not without the tracks, these are deleted and it is taken in; errors of
        a provider are raised every time.
        """
        require_type("frame", frame, Frame)
        state = self._state.copied(taking_over=True)
        try:
            reported = self._step(state, frame)
        except BaseException as error:
            if (named := self._of_own_part(error)) is not None:
                raise named from error
            if self.providers and isinstance(error, ProviderError | UndeterminedError):  # tracks are not to blame
                raise
            failed_before, self._last_step_failed = self._last_step_failed, isinstance(error, Exception)
            if not (failed_before and self._last_step_failed and len(self._state)):
                raise
            state = self._state.copied()
            state.clear()
            reported = self._step(state, frame)  # fails where the frame is to blame
            log.warning("tracks %s are deleted, they can't go on: %s", self._state.table.id.tolist(), error)
        self._state, self._last_step_failed = state, False
        return reported

    def _of_own_part(self, error: BaseException) -> InputError | None:
        """The error of a part that is not of this package, with its name; None for one of another origin."""
        if not isinstance(error, Exception) or isinstance(error, SagaError):
            return None
        settings, edges = self.settings, self.settings.edges
        parts: list[tuple[str, Any]] = [
            *((f"classes.{label}.motion", one.motion) for label, one in settings.classes.items()),
            *((f"sensors.{name}", sensor) for name, sensor in self.sensors.items()),
            *((f"sensors.{name}.class_model", model) for name, model in self._state.confused.models.items()),
            *((f"association.costs[{k}]", cost) for k, cost in enumerate(self._state.costs)),
            *((f"edges[{k}].interaction", rule.interaction) for k, rule in enumerate(edges)),
            *((f"edges[{k}]", rule) for k, rule in enumerate(edges)),
            ("estimator", self._state.joint.estimator),
        ]
        modules = [(getattr(part, "__module__", "saga_fg."), where, part) for where, part in parts]
        own = [(name, f"{k} ({part_name(p)})", p) for name, k, p in modules if not name.startswith("saga_fg.")]
        calls = [call for call, _ in walk_tb(error.__traceback__)]
        blamed = [where for call in calls for _, where, part in own if call.f_locals.get("self") is part]
        if not blamed:
            names = [call.f_globals.get("__name__") for call in calls]
            blamed = [where for name in names for module, where, _ in own if module == name]
        return InputError(f"{blamed[-1]}: {in_one_line(error)}") if blamed else None

    def _step(self, state: TrackerState, frame: Frame) -> Tracks:
        """Take a frame into a state."""
        sensor = self.sensor(frame.sensor)
        timestamp = sensor.measured_at(frame)
        if state.accept_time(timestamp, frame.sensor, self.max_jump, self.max_delay):
            time = state.relative(state.clock.time_of(timestamp, frame.sensor))
            return self._process_frame(state, frame, sensor, time)
        several, placed = len(state.clock.sensors) > 1, frame.coordinates == "world" or frame.world_T_ego is not None
        if several and placed and len(frame):  # left out of the tracks, but it tells about the clocks
            measurements = frame_measurements(frame, sensor, self.settings.classes, state.confused)
            state.clock, state.shared = compared(state.clock, state.shared, timestamp, measurements)
        state.assignment = Assignment.empty()
        return report_tracks(state, state.clock.newest)

    def _process_frame(self, state: TrackerState, frame: Frame, sensor: Sensor, time: float) -> Tracks:
        """Predict to the `time` of a frame, s from the state's start, unless it is in the past, and use the frame."""
        if state.joint.empty:
            state.set_origin(frame)
        before, delay = state.time, max(0.0, state.time - time)
        for road_map in (self.settings.road_map, frame.road_map):
            named = None if road_map is None else state.map_nodes.add(road_map, state.origin, state.joint)
            if named is not None:
                state.traffic.add_lanes(named.lanes)
                state.halting = state.halting.with_lines(named.stop_lines, state.origin)
        state.joint.set_frame(frame, state.origin)
        predict_state(state, max(time, before))
        frame = state.ego.located(frame, state.world_T_ego)
        if delay == 0:
            state.ego.update(frame, state.time, state.origin, state.joint)
        self._notify("predict", state, frame.sensor)

        measurements = frame_measurements(frame, sensor, self.settings.classes, state.confused)
        by_model, noise = measurements, state.noise.get(frame.sensor, UNMEASURED)
        if sensor.calibrate_noise:
            measurements = with_found_noise(measurements, noise)
        measurements = measurements.with_context(delay, state.ego.relative_positions(measurements, frame))
        stamp = sensor.measured_at(frame)
        state.clock, state.shared = compared(state.clock, state.shared, stamp, measurements)
        state.map_nodes.update(frame, sensor, state.origin, state.joint, delay)
        look(state, measurements)
        self._notify("measure", state, frame.sensor, measurements)

        gated = for_gates(measurements, noise) if sensor.calibrate_noise else measurements
        matching, rivals = associate(state, gated)
        self._notify("associate", state, frame.sensor, measurements, matching)

        if sensor.calibrate_noise and not noise.settled and delay == 0:
            noise = noise_after(noise, by_model, matching, state.table.id[matching.track], state.time)
            state.noise = {**state.noise, frame.sensor: noise}
        if delay == 0:
            follow_encounters(state, measurements, matching, rivals, state.time - before)
        update_tracks(state, measurements, matching)
        if delay == 0:
            infer_signals(state, matching)
            judge_edges(state)
        self._notify("update", state, frame.sensor, measurements, matching)

        update_existence(state, measurements, matching, state.time - before)
        resolve_tracks(state, matching)
        self._notify("existence", state, frame.sensor, measurements, matching)

        matching = hand_over(state, matching)
        rows = initiate_tracks(state, measurements, matching)
        state.joint.ask_providers()
        state.joint.set_frame(None, state.origin)
        self._notify("initiate", state, frame.sensor, measurements, matching, rows)
        ids = np.concatenate([state.table.id[matching.track], state.table.id[len(state) - len(rows) :]])
        detections = np.concatenate([matching.detection, rows])
        state.assignment = Assignment(ids, measurements.row[detections])
        given = measurements.identity[detections]
        state.identities = state.identities.updated(frame.sensor, given, ids, state.table.id, time)

        if delay == 0:
            matching = exchange_identities(state, matching)
        delete_tracks(state)
        self._notify("delete", state, frame.sensor, measurements, matching)

        reported = report_tracks(state, state.clock.newest)
        self._notify("report", state, frame.sensor, measurements, matching)
        return reported

    def _notify(self, stage: Stage, state: TrackerState, sensor: str, *results: Any) -> None:
        if self.observer is not None:
            self.observer.after(stage, lambda: TrackerView.from_state(state, sensor, *results))

    def tracks(self, timestamp: float) -> Tracks:
        """The tracks predicted to `timestamp` (s), without taking anything in; the present ones for an earlier time.

        Left out are tracks that can't be predicted that far. Raises `InputError` for a timestamp that is not finite.
        """
        timestamp = finite_seconds(timestamp)
        newest = self._state.clock.newest
        if newest == -math.inf:
            return Tracks.empty(timestamp)
        if timestamp <= newest:
            return report_tracks(self._state, timestamp)
        ahead = self._state.copied()
        predict_state(ahead, ahead.relative(min(timestamp, newest + LATEST)))
        return report_tracks(ahead, timestamp)

    def predict(
        self, horizons: ArrayLike, joint: bool = False, since: float | None = None, hypotheses: bool = False
    ) -> PredictedTracks:
        """The tracks reported now at future times, with the edges of the graph that go on to act.

        horizons    (H,) s, increasing, from 0 to 60
        joint       with the joint covariance of all positions at each of these times
        since       timestamp from which the horizons count, s; the newest frame's if left out
        hypotheses  where `edge_prior` is below 1: modes for who waits for others, follows, or goes on; takes four times
                    as long, and there is none with `joint`

        Nothing is taken in or changed. Left out are tracks that can't be predicted that far. Raises `InputError` for
        other horizons, also as counted from the newest frame, and before the first frame.
        """
        checked, newest = checked_horizons(horizons), self._state.clock.newest
        if joint and hypotheses:
            raise InputError("predict: expected joint or hypotheses, got both")
        if newest == -math.inf:
            raise InputError("predict: expected a frame before, there is no time to predict from")
        since = newest if since is None else finite_seconds(since)
        ahead = checked + (since - newest)
        if not within_reach(ahead):
            got = f"{since + checked[0]:.10g} to {since + checked[-1]:.10g}"
            within = f"from the newest frame, at {newest:.10g} s, to {LONGEST_PREDICTION:g} s later"
            raise InputError(f"predict: expected times {within}, got {got}")
        try:
            found = look_ahead(self._state.copied(), ahead, joint, hypotheses)
        except Exception as error:
            if (named := self._of_own_part(error)) is not None:
                raise named from error
            raise
        return replace(found, timestamp=since, horizons=checked)

    def snapshot(self) -> TrackerSnapshot:
        """Everything that the tracker knows, as a value."""
        return self._state.snapshot()

    def restore(self, snapshot: TrackerSnapshot) -> None:
        """Continue from a snapshot of a tracker of the same settings; one snapshot can be used many times."""
        require_type("snapshot", snapshot, TrackerSnapshot)
        self._state.restore(snapshot)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.settings, self.sensors, None, self.providers), self.snapshot()

    __setstate__ = restore

    def take_clocks(self, other: Tracker) -> None:
        """Take over the usual steps and the records of the sensors' clocks from a tracker of the scene before."""
        self._state.clock = other._state.clock.begun_anew()

    def sensor(self, name: str) -> Sensor:
        """The model of a sensor."""
        return sensor_model(self.sensors, name)

    def classes_of(self, ids: IntArray) -> StrArray:
        """The present classes (k,) of live tracks, reported or not."""
        return self._state.table.label[self._state.table.rows(ids)]

    @property
    def assignment(self) -> Assignment:
        """Tracks and detections of the latest frame that belong together."""
        return self._state.assignment

    @property
    def time_verdict(self) -> TimeVerdict:
        """The verdict on the timestamp of the latest frame, see `saga_fg.tracking.clock`."""
        return self._state.time_verdict

    @property
    def sensor_times(self) -> dict[str, SensorTime]:
        """The clock of each sensor against the consensus of all: offset, its standard deviation, drift and jitter."""
        return sensor_times(self._state.clock, self._state.shared)

    @property
    def sensor_noise(self) -> dict[str, SensorNoise]:
        """The noise of sensors with `calibrate_noise`, by name, as far as their detections tell it."""
        return {name: noise for name, noise in self._state.noise.items() if noise.seen}

    @property
    def late_frames(self) -> int:
        """Number of frames left out because they came late."""
        return self._state.late_frames

    @property
    def graph(self) -> SceneGraph | None:
        """The scene graph of the latest interval."""
        return self._state.graph

    @property
    def world_T_ego(self) -> FloatArray | None:
        """The vehicle's pose (4, 4) as estimated in the running graph; None where it is not."""
        return self._state.world_T_ego

    @property
    def plain_snapshots(self) -> bool:
        """Whether snapshots are plain values, which go into a file without pickling."""
        models = self._state.joint.estimator.snapshots_hold_models
        return not (models and self.settings.nonlinear(self.settings.edges))

    @property
    def running_graph(self) -> SceneFactorGraph:
        """Variables, factors and values of the graph; with `isam2` and `fixed-lag` it is the one that runs."""
        return self._state.joint.estimator.graph()

    @property
    def map_nodes(self) -> MapNodes:
        """Lights, stop lines, lanes and walls known from maps."""
        return self._state.map_nodes

    @property
    def max_jump(self) -> float:
        """Distance from the newest frame from which another has to be confirmed, s; tracks can outlive shorter ones."""
        settings = self.settings
        return max(settings.max_jump, settings.max_coasting if math.isfinite(settings.max_coasting) else 0.0)

    @property
    def max_delay(self) -> float:
        """Age up to which a late frame is used, s."""
        estimated = self.settings.ego is not None and self.settings.ego.estimated  # earlier poses are not kept
        return 0.0 if estimated else max(self.settings.max_delay, self._state.joint.window)
