"""Tracking and prediction of a whole table of detections in one call; one that contradicts how it is read is refused.

`dense_traffic_settings` are those for a sensor that stands or hovers over a road. Drones and roadside sensors give
vehicles with headings, many at a time and often. There a vehicle keeps to its course, to the trails of those before it,
and does what its leader does (`saga_fg.tracking.traffic`). The motion of vehicles was chosen on half of the windows of
two recorded roads, and confirmed on the others.

`IdentityTracker` takes the place of trackers that number detections: `update(detections)`, as of supervision and
`trackers`.
"""

import copy
import warnings
from collections import deque
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike

from saga_fg.errors import InputError, require_type
from saga_fg.model import (
    ConstantVelocity,
    Curvilinear,
    Following,
    GreenLight,
    GroundCamera,
    RedLight,
    Sensor,
    SharedVelocity,
    Stopping,
    acting_classes,
    checked_sensors,
    sensor_model,
)
from saga_fg.numerics import IntArray, checked
from saga_fg.tables import (
    Table,
    TableImport,
    idle_rules,
    raw_table,
    scenes_of,
    seems_dense_traffic,
    table_like,
    tell,
)
from saga_fg.tracking.greedy import GreedyTracker
from saga_fg.tracking.settings import AssociationSettings, ClassSettings, Method, TrackerSettings
from saga_fg.tracking.tracker import Tracker
from saga_fg.tracking.traffic import TrafficSettings
from saga_fg.types import (
    DEFAULT,
    LONGEST_PREDICTION,
    Detections,
    Frame,
    PredictedTracks,
    Scene,
    SignalSettings,
    Tracks,
    checked_horizons,
    within_reach,
)


@cache
def dense_traffic_settings() -> TrackerSettings:
    """Settings of the tracker for dense road traffic, of which nothing else is known."""
    return TrackerSettings(
        classes={
            DEFAULT: ClassSettings(
                motion=Curvilinear(jerk_noise=0.3, fading_time=4.0, course_time=0.2),
                initial_speed_deviation=8.0,
                gate=0.99999,
                initiation_score=0.3,
                nms_distance=1.0,
                max_distance=8.0,
                max_deviation=3.0,
            ),
            "pedestrian": ClassSettings(
                motion=ConstantVelocity(acceleration_noise=0.3),
                initial_speed_deviation=1.2,
                initial_lateral_speed_deviation=1.2,
                gate=0.99999,
                initiation_score=0.3,
                nms_distance=0.3,
                max_distance=2.0,
                max_deviation=1.5,
            ),
        },
        min_hits=2,
        traffic=TrafficSettings(memory=60.0),
        edges=(
            RedLight(interaction=Stopping(margin=0.5), reaction_deceleration=0.8, full_deceleration=1.8),
            GreenLight(),
            Following(  # parked: all are on the road, and who was never seen moving waits in a queue
                interaction=SharedVelocity(along_heading=True),
                rate=1.5,
                max_gap=60.0,
                gap_scale=16.0,
                lateral_scale=0.8,
                parked=True,
            ),
        ),
        edge_prior=0.95,  # edges answer for themselves: a leader who has crossed the line no longer leads
        signals=SignalSettings(red_duration=70.0, amber_duration=3.5, green_duration=25.0, driver_noise=1.0),
        association=AssociationSettings(clutter_area=5000.0),
    )


@cache
def plain_settings() -> TrackerSettings:
    """Settings for a table that is no dense traffic: most detectors have false boxes that never come twice."""
    return TrackerSettings(min_hits=2)


SettingsName = Literal["plain", "dense"]
"""Settings by name: `plain_settings`, or `dense_traffic_settings`."""

UNKNOWN_SENSORS: Mapping[str, Sensor] = {DEFAULT: Sensor(calibrate_noise=True, clutter_area=5000.0)}
"""Models of sensors of which nothing is known: their detections tell how noisy they are, and their scores how many of a
frame are false."""

NO_TRACKS = "{} detections, no track: none is probable, or comes where one is expected; {} expects more between frames"
"""Warning of detections that give no track, to be formatted with their number and the option to try."""

UNNAMED = "object"
"""Class of detections without a column of classes; any name will do."""


def track(
    detections: Table,
    settings: TrackerSettings | SettingsName | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    how: TableImport | None = None,
    method: Method = "saga",
) -> Table:
    """Track a table of detections, of pandas, Polars or Arrow, and return one of tracks, a row for each and moment.

    detections  a row for each: timestamp (s, or dates), x, y (m), and where known z, label, score, sensor, length,
                width, height, yaw (rad), vx, vy, range_rate, cov_xx, cov_xy, cov_yy (m^2), scene, and ego_x,
                ego_y, ego_yaw, the vehicle's pose; a row without x and y is a moment at which nothing was detected
    settings    of the tracker, such as `replace(saga_fg.tracking.plain_settings(), estimator="isam2")`; dense: for
                road traffic seen by a sensor that stands or hovers; plain: for all else, where tracks are reported
                from their second detection on; by default those of the two that fit the first scene
    sensors     models by name of the sensor; by default the noise of each is told by its detections
    how         what it takes to understand the table: columns, classes, units, coordinates, as_given
    method      saga, kf (without edges, trails and lanes), or centerpoint (greedy nearest centre, with settings of its
                own)

    Frames are taken in order of time, each by what came before it. The table of tracks is of the same kind; it has a
    column `scene` if the detections have one, and each scene has a tracker of its own. Warns (`UserWarning`) of what is
    probably wrong, by the checks of `saga-fg inspect`. Raises `InputError` for a table that can't be used, and for one
    whose contents contradict how it is read: units of angles, times, lengths or speeds, coordinates, exchanged columns.
    """
    _tell_default(settings)
    found = read_scenes(detections, how, settings, sensors, method)
    parts, boxes, detections_seen = [], 0, 0
    for scene in found.scenes:
        tracker = found.new_tracker()
        for frame in scene.frames:
            tracks = tracker.step(frame)
            parts.append(found.named(scene.name, tracks.table_columns()))
            boxes, detections_seen = boxes + len(tracks), detections_seen + len(frame.detections)
    if detections_seen and not boxes:
        warnings.warn(NO_TRACKS.format(detections_seen, "settings='dense'"), stacklevel=2)
    return table_like(detections, parts or [found.named("", Tracks.empty(0.0).table_columns())])


HORIZONS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)


def predict(
    detections: Table,
    horizons: ArrayLike = HORIZONS,
    times: ArrayLike | None = None,
    modes: bool = False,
    settings: TrackerSettings | SettingsName | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    how: TableImport | None = None,
    method: Method = "saga",
) -> Table:
    """Predict where all tracks of a table of detections will be, and return a table: a row for each track and horizon.

    detections  and the arguments from settings on as of `track`, with the same tracks
    horizons    (H,) s, increasing, from 0 to 60
    times       (T,) from which to predict, s as in the table of tracks, in any order; the last frame of each scene if
                left out. Nothing that comes after a time has an influence on what is predicted from it.
    modes       a row for each mode, with `probability`; otherwise mean and covariance. Modes: moving, stationary; with
                settings for dense traffic waits, follows, goes on

    The table is of the same kind, with the columns of `PredictedTracks.table_columns`, and `scene` if the detections
    have one. Warns and raises as `track`. Warns of times that are left out: those in no scene, and those from which a
    horizon is more than 60 s after the last frame before it.
    """
    ahead, wanted = checked_horizons(horizons), None if times is None else np.sort(checked("times", times, (None,)))
    if method == "centerpoint":
        raise InputError("method: expected saga or kf, centerpoint predicts nothing")
    _tell_default(settings)
    found = read_scenes(detections, how, settings, sensors, method)
    parts, left_out, spans = [], set(() if wanted is None else wanted.tolist()), []
    for scene in found.scenes:
        stamps = found.stamps(scene)
        tracker, frames = Tracker(found.settings, found.sensors), deque(zip(stamps, scene.frames, strict=True))
        first, last = stamps[0], max(stamps)
        spans.append(f"{first:.10g} to {last:.10g}")
        here = np.array([last]) if wanted is None else wanted[(wanted >= first) & (wanted <= last)]
        for time in here.tolist():
            while frames and frames[0][0] <= time:
                newest = tracker.step(frames.popleft()[1]).timestamp
            if within_reach(ahead + (time - newest)):
                parts.append(
                    found.named(scene.name, tracker.predict(ahead, since=time, hypotheses=modes).table_columns(modes))
                )
                left_out.discard(time)
    if left_out:
        within = f"within a scene ({', '.join(spans[:6])}), at most {LONGEST_PREDICTION:g} s from a frame to a horizon"
        some = ", ".join(f"{time:.10g}" for time in sorted(left_out)[:6])
        warnings.warn(f"times: expected seconds {within}; left out: {some}", stacklevel=2)
    return table_like(detections, parts or [found.named("", PredictedTracks.empty(0.0, ahead).table_columns(modes))])


def _tell_default(settings: TrackerSettings | SettingsName | None) -> None:
    """Warn, at the caller's caller, of a default that fits no table, where others were changed."""
    usual = TrackerSettings()
    if isinstance(settings, TrackerSettings) and settings != usual and settings.min_hits == usual.min_hits:
        what = f"settings: min_hits is at its default, {settings.min_hits}"
        what = f"{what}, where tables without settings have {plain_settings().min_hits}"
        warnings.warn(f"{what}: change what saga_fg.tracking.plain_settings() gives", stacklevel=3)


class TableScenes(NamedTuple):
    """The scenes of a table of detections, and how to track them; is_named: they have a column `scene`; dense: the
    settings are those of `dense_traffic_settings`."""

    scenes: list[Scene]
    settings: TrackerSettings
    sensors: Mapping[str, Sensor]
    is_named: bool
    method: Method
    dense: bool

    def new_tracker(self) -> Tracker | GreedyTracker:
        """Return a tracker for one of them."""
        if self.method == "centerpoint":
            return GreedyTracker(sensors=self.sensors)
        return Tracker(self.settings, self.sensors)

    def stamps(self, scene: Scene) -> list[float]:
        """Return the times of the frames of a scene by the clock of its tracks, s: with the offsets of sensors."""
        return [sensor_model(self.sensors, frame.sensor).measured_at(frame) for frame in scene.frames]

    def named(self, scene: str, columns: Mapping[str, Any]) -> dict[str, Any]:
        """Columns of a table about a scene, with its name where scenes have one."""
        name = {"scene": np.full(len(columns["id"]), scene)} if self.is_named else {}
        return name | dict(columns)


def read_scenes(
    detections: Table,
    how: TableImport | None,
    settings: TrackerSettings | SettingsName | None,
    sensors: Mapping[str, Sensor] | None,
    method: Method,
) -> TableScenes:
    """Read a table; arguments as of `track`. Settings that are left out are those that fit its first scene.

    Warns of those for dense traffic and of what is doubtful, at the caller's caller; raises as `tell`.
    """
    if method not in get_args(Method):
        raise InputError(f"method: expected one of {', '.join(get_args(Method))}, got {method!r}")
    if isinstance(settings, str) and settings not in get_args(SettingsName):
        raise InputError(f"settings: expected {', '.join(get_args(SettingsName))} or TrackerSettings, got {settings!r}")
    if not isinstance(settings, str | None):
        require_type("settings", settings, TrackerSettings)
    if method == "centerpoint" and settings is not None:
        raise InputError("settings: expected None with method='centerpoint', which has its own")
    sensors = UNKNOWN_SENSORS if sensors is None else checked_sensors(sensors)
    raw = raw_table(detections, how)
    scenes = scenes_of(raw)
    own = isinstance(settings, TrackerSettings) and settings.traffic == TrackerSettings().traffic
    undecided = (settings is None or own) and method != "centerpoint"
    why = seems_dense_traffic(scenes[0].frames) if scenes and undecided else ""
    if why and own:
        what = "settings: dense_traffic_settings() of saga_fg.tracking may fit better than those given"
        warnings.warn(f"{what}, as 'dense' does: {why}", stacklevel=3)
    elif why:
        warnings.warn(f"settings for dense traffic: {why}; settings='plain' takes others", stacklevel=3)
        settings = "dense"
    dense = settings == "dense"
    if not isinstance(settings, TrackerSettings):
        settings = dense_traffic_settings() if dense else plain_settings()
    settings = settings.of_method(method)
    frames = [frame for scene in scenes for frame in scene.frames]
    labels = {name for frame in frames for name in frame.detections.boxes.label.tolist()}
    logits = any(sensor_model(sensors, name).score == "logit" for name in {frame.sensor for frame in frames})
    findings = [one for scene in scenes for one in scene.findings or () if one.kind != "scores" or not logits]
    rules = idle_rules(acting_classes(settings.edges), labels - {UNNAMED})
    tell([*findings, *raw.how.judged([] if rules is None else [rules], raw.found.names, raw.within)], raw, depth=4)
    return TableScenes(scenes, settings, sensors, "scene" in raw.columns, method, dense)


D = TypeVar("D")
SENSOR = "camera"


class IdentityTracker:
    """Gives each detection of a frame the number of its track.

    camera      places image boxes on the ground; None for detections in the world
    frame_rate  frames per second, where `update` is told no times
    settings    of the tracker; by default tracks are reported from their second detection on
    sensor      the model of the detector
    classes     names by class id; the number is the name of those left out
    """

    def __init__(
        self,
        camera: GroundCamera | None = None,
        frame_rate: float = 30.0,
        settings: TrackerSettings | None = None,
        sensor: Sensor | None = None,
        classes: Mapping[int, str] | None = None,
    ) -> None:
        if not frame_rate > 0:
            raise InputError(f"frame_rate: expected a number > 0, got {frame_rate!r}")
        self.camera, self.frame_rate, self.classes = camera, frame_rate, dict(classes or {})
        self.tracker = Tracker(settings or plain_settings(), {} if sensor is None else {SENSOR: sensor})
        self._time = 0.0

    def update(self, detections: D, timestamp: float | None = None) -> D:
        """Return the detections of the next frame with the numbers of their tracks, -1 for none; timestamp: s.

        They have `xyxy` (n, 4), px, and may have `confidence` (n,) and `class_id` (n,), and are returned with
        `tracker_id` (n,), as those of supervision; or they are `saga_fg.Detections` in the world, and are returned with
        `identity`. Raises `InputError` for detections that are neither; the tracker is then as it was before.
        """
        time = self._time if timestamp is None else timestamp
        found, rows = self._placed(detections)
        name = "identity" if isinstance(detections, Detections) else "tracker_id"
        tracks = self.tracker.step(Frame(time, SENSOR, found))
        self._time = time + 1 / self.frame_rate
        id_, row = self.tracker.assignment.id, self.tracker.assignment.detection
        reported, numbers = np.isin(id_, tracks.id), np.full(len(getattr(detections, "xyxy", rows)), -1)
        numbers[rows[row[reported]]] = id_[reported]
        numbered = copy.copy(detections)
        vars(numbered)[name] = numbers
        return numbered

    def _placed(self, detections: Any) -> tuple[Detections, IntArray]:
        """Detections in the world, and their rows: image boxes are placed on the ground."""
        if isinstance(detections, Detections):
            return detections, np.arange(len(detections))
        if self.camera is None or not hasattr(detections, "xyxy"):
            expected = (
                "detections with xyxy" if self.camera is not None else "saga_fg.Detections, as there is no camera"
            )
            raise InputError(f"detections: expected {expected}, got {type(detections).__name__}")
        xyxy = checked("xyxy", detections.xyxy, (None, 4))
        score, class_id = (getattr(detections, name, None) for name in ("confidence", "class_id"))
        score = np.ones(len(xyxy)) if score is None else checked("confidence", score, (len(xyxy),))
        numbers = [] if class_id is None else checked("class_id", class_id, (len(xyxy),)).astype(np.int64).tolist()
        names = [UNNAMED] * len(xyxy) if class_id is None else [self.classes.get(k, str(k)) for k in numbers]
        label = np.array(names, dtype=np.str_)
        return self.camera.detections(xyxy, score, label)
