"""Warnings of what is probably wrong in data and settings, each once, by the checks of `saga_fg.tables`.

A table whose contents contradict how it is read is refused.
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from data_tools.datasets.source import DatasetSource
from pipelines.config import TrackConfig
from saga_fg import Curvilinear, Dataset, Frame, InputError, Scene, TrackerSettings, Tracks
from saga_fg.model import acting_classes, sensor_model
from saga_fg.numerics import FloatArray
from saga_fg.tables import Sample, findings_of, idle_lanes, idle_rules, seems_dense_traffic, settings_without_data
from saga_fg.tracking import estimator_parameters
from saga_fg.types import DEFAULT, LANE, MAP_CLASSES, STOP_LINE, Finding, Mend, refuse_contradictions

log = logging.getLogger(__name__)

FRAMES = 100  # with tracks, after which a live stream is judged
SCENES = 3  # of a dataset, whose first frames are judged


def options_of(source: DatasetSource) -> Callable[[Mend], str]:
    """Return the function from a `Mend` to options of the command; "" for datasets that no `TableImport` reads."""
    how = getattr(source, "how", None)
    return lambda mend: "" if how is None else how.option_for(mend, {})


class Checks:
    """Warns of each suspicion once.

    settings    of the run
    usual       the shipped settings: what a file for --config adds to them should meet something in the data
    option_for  the options of the command that mend a suspicion, "" for none
    live_plain  whether live frames that look like dense traffic are told, as --settings and --config are left out
    """

    def __init__(
        self,
        settings: TrackConfig,
        usual: TrackConfig | None = None,
        option_for: Callable[[Mend], str] = lambda mend: "",
        live_plain: bool = False,
    ) -> None:
        self._settings, self._option_for, self._live_plain = settings, option_for, live_plain
        self._acting = acting_classes(settings.tracker.edges)
        usual = usual or settings
        self._own_classes = set(settings.tracker.classes) - set(usual.tracker.classes) - {DEFAULT}
        self._own_sensors = set(settings.sensors) - set(usual.sensors) - {DEFAULT}
        self._told: set[str] = set()
        self._classes: set[str] = set()
        self._detected: set[str] = set()
        self._sensors: set[str] = set()
        self._judged = 0
        self._live: list[Frame] = []
        self._yaw: list[FloatArray] = []
        self._tracked_frames = 0
        self._tell(_without_effect(settings.tracker, usual.tracker))

    def over(self, scenes: Iterable[Scene]) -> Iterator[Scene]:
        """Pass scenes on, and warn of what looks wrong in the first of them."""
        for scene in scenes:
            self.see(scene)
            yield scene

    def see(self, scene: Scene) -> None:
        """Warn of what looks wrong in a scene, one of the first.

        Raises `InputError` where its contents contradict how it is read.
        """
        sample = Sample.from_frames(scene.frames)
        self._note(sample)
        if self._judged < SCENES:
            self._judged += 1
            self._tell(self._found_in(scene, sample))

    def see_first(self, source: DatasetSource) -> None:
        """See the first part of recordings that are done elsewhere; what cannot be read is said there.

        Raises `InputError` as `see`.
        """
        found: list[Finding] = []
        with suppress(InputError), source.parts() as there:
            first = next(iter(there.parts), None)
            if first is None:  # tracks of other trackers alone
                return
            with first.opened() as part:
                dataset = part.read()
                scene = dataset.scene(dataset.scenes[0])
                found = self._found_in(scene, Sample.from_frames(scene.frames))
        self._tell(found)

    def _found_in(self, scene: Scene, sample: Sample) -> list[Finding]:
        if scene.findings is None:
            return findings_of(sample, self._logits)
        logits = any(self._logits(name) for name in np.unique(sample.sensor).tolist())
        return [finding for finding in scene.findings if finding.kind != "scores" or not logits]

    def add(self, classes: Iterable[str]) -> None:
        """Note classes of tracks."""
        self._classes.update(classes)

    def finish(self) -> None:
        """Warn of rules and settings that met nothing, when all is seen."""
        classes, sensors = self._settings.tracker.classes, self._settings.sensors
        found = [idle_rules(self._acting, self._classes), idle_lanes() if self._lanes_idle() else None]
        if self._detected and self._own_classes - self._detected:
            found.append(settings_without_data("tracker.classes", set(classes) - {DEFAULT}, self._detected))
        if self._sensors and self._own_sensors - self._sensors:
            found.append(settings_without_data("sensors", set(sensors) - {DEFAULT}, self._sensors))
        self._tell([finding for finding in found if finding is not None])

    def watch(self, frame: Frame, yaw: FloatArray, tracks: Tracks) -> None:
        """Note a live frame, its headings (n,) as they were given and the tracks; judge after `FRAMES` with tracks."""
        if self._tracked_frames >= FRAMES:
            return
        self._live.append(frame)
        self._yaw.append(yaw)
        self.add(tracks.boxes.label.tolist())
        self._tracked_frames += bool(len(tracks))
        if self._tracked_frames >= FRAMES or len(self._live) > 10 * FRAMES:
            self._tracked_frames = FRAMES
            sample = Sample.from_frames(self._live, np.concatenate(self._yaw))
            self._note(sample)
            self._tell(findings_of(sample, self._logits))
            why = seems_dense_traffic(self._live) if self._live_plain else ""
            if why:
                self._tell(
                    [Finding("dense", f"dense traffic: {why}", "expected settings for it", option="--settings dense")]
                )
            self.finish()
            self._live, self._yaw = [], []

    def _note(self, sample: Sample) -> None:
        self._detected.update(np.unique(sample.boxes.label).tolist())
        self._sensors.update(np.unique(sample.sensor).tolist())

    def _lanes_idle(self) -> bool:
        """True if there are lanes in the settings and nothing else there reads them, in a tracker that could."""
        tracker = self._settings.tracker
        if tracker.road_map is None or not tracker.road_map.lanes or not (tracker.edges or tracker.traffic.reach > 0):
            return False
        read = {name for rule in tracker.edges for name in getattr(rule, "map_classes", MAP_CLASSES)} & {
            LANE,
            STOP_LINE,
        }
        motions = [each.motion for each in tracker.classes.values()]
        courses = any(isinstance(motion, Curvilinear) and motion.course_time > 0 for motion in motions)
        return not read and not (courses and tracker.traffic.reach > 0)

    def _logits(self, sensor: str) -> bool:
        return sensor_model(self._settings.sensors, sensor).score == "logit"

    def _tell(self, findings: Iterable[Finding]) -> None:
        findings = list(findings)
        refuse_contradictions(findings)
        for finding in findings:
            if finding.kind not in self._told:
                self._told.add(finding.kind)
                option = self._option_for(finding.mend) if finding.mend is not None and not finding.option else ""
                log.warning("%s", replace(finding, option=finding.option or option))


def _without_effect(tracker: TrackerSettings, usual: TrackerSettings) -> Iterator[Finding]:
    """Settings, other than the shipped ones, that the estimator does not have."""
    name, given = tracker.estimator, []
    has = estimator_parameters(name)
    if "lag" not in has and tracker.lag != usual.lag:
        given.append(f"lag: {tracker.lag:g}")
    if "tolerance" not in has and tracker.tolerance not in (0.0, usual.tolerance):
        given.append(f"tolerance: {tracker.tolerance:g}")
    if "max_component" not in has and tracker.max_component < usual.max_component:
        given.append(f"max_component: {tracker.max_component}")
    if given:
        what = f"tracker: {', '.join(given)}: without effect with estimator: {name}"
        yield Finding("estimator", what, "lag is of fixed-lag, tolerance and max_component are of kalman")


class CheckedDataset:
    """A dataset whose scenes are looked at when they are read."""

    def __init__(self, dataset: Dataset, checks: Checks) -> None:
        self._dataset, self._checks = dataset, checks
        self.scenes = dataset.scenes

    def scene(self, name: str) -> Scene:
        """Read a scene, and warn of what looks wrong in it."""
        scene = self._dataset.scene(name)
        self._checks.see(scene)
        return scene
