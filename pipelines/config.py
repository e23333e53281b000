"""The configuration of tracking: the settings of every part, composed, and the defaults shipped for kinds of data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Literal, get_args

from pipelines.configuration import load_settings, read_settings
from saga_fg import ConstantVelocity, Curvilinear, GreedyTracker, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.errors import unknown_name
from saga_fg.model import Following, LearnedInteractions, Neighbours
from saga_fg.settings import settings_group
from saga_fg.tracking import AssociationName, ClassSettings, GreedySettings, Observer, dense_traffic_settings
from saga_fg.tracking import Method as Method
from saga_fg.types import DEFAULT, class_settings

METHODS: tuple[Method, ...] = get_args(Method)
Family = Literal["nuscenes", "kitti", "simulated", "heterogeneous", "traffic", "dense", "file"]

OTHER_FILES = {"smoothing": "saga-fg smooth", "tracking": "saga-fg smooth", "slam": "saga-fg slam"}
"""Sections that only the files of other commands have."""


@dataclass(frozen=True)
class TrackConfig:
    """Configuration of tracking."""

    tracker: TrackerSettings = settings_group(
        TrackerSettings, "the tracker of the methods saga and kf (kf: without edges, trails and lanes)"
    )
    greedy: GreedySettings = settings_group(GreedySettings, "the tracker of the method centerpoint")
    sensors: Mapping[str, Sensor] = settings_group(
        lambda: {DEFAULT: Sensor()}, "models of the sensors by name; the entry named default serves all others"
    )

    def with_estimator(self, estimator: str | None, lag: float | None) -> TrackConfig:
        """Return a copy with this estimator and window (s); None keeps the present one."""
        tracker = self.tracker
        name = tracker.estimator if estimator is None else estimator
        tracker = replace(tracker, estimator=name, lag=tracker.lag if lag is None else lag)
        return replace(self, tracker=tracker)

    def with_association(self, method: AssociationName | None) -> TrackConfig:
        """Return a copy with this association method; None keeps the present one."""
        if method is None:
            return self
        association = replace(self.tracker.association, method=method)
        return replace(self, tracker=replace(self.tracker, association=association))

    def with_motions(self, motions: Mapping[str, ConstantVelocity | Curvilinear]) -> TrackConfig:
        """Return a copy with these motions by class; `default` serves the rest."""
        classes = dict(self.tracker.classes)
        for label, motion in motions.items():
            classes[label] = replace(class_settings(classes, ClassSettings, label), motion=motion)
        return replace(self, tracker=replace(self.tracker, classes=classes))

    def with_interactions(self, learned: LearnedInteractions) -> TrackConfig:
        """Return a copy with learned edge rules in place of those that can be learned, and with their explained noise.

        Process noise stays, as association needs more of it than prediction; so do signals, lanes, lines and walls.
        """
        others = tuple(rule for rule in self.tracker.edges if not isinstance(rule, Following | Neighbours))
        edges, explained = learned.edges + others, learned.explained_noise
        return replace(self, tracker=replace(self.tracker, edges=edges, explained_noise=explained))

    def new_tracker(self, method: Method, observer: Observer | None = None) -> Tracker | GreedyTracker:
        """A fresh tracker: `saga`, `kf` (without edges, trails and lanes) or `centerpoint` (greedy nearest centre).

        The `observer` watches the first two; `centerpoint` tells nothing.
        """
        if method == "centerpoint":
            return GreedyTracker(self.greedy, self.sensors)
        return Tracker(self.of_method(method).tracker, self.sensors, observer=observer)

    def of_method(self, method: Method) -> TrackConfig:
        """Return a copy for a method: without edges, trails and lanes, unless it is `saga`."""
        return replace(self, tracker=self.tracker.of_method(method))


def load_interactions(path: Path) -> LearnedInteractions:
    """Read the file of `saga-fg learn interactions`. Raises `InputError` naming file and dotted key of a mistake."""
    return load_settings(LearnedInteractions, path)


def shipped_settings(family: str, folder: str = ".") -> Traversable:
    """The YAML file shipped for a kind of data, in a folder of `pipelines/configs`; `InputError` if there is none."""
    there = {
        Path(file.name).stem: file for file in (files("pipelines") / "configs" / folder).iterdir() if file.is_file()
    }
    if family not in there:
        what = "kind of data" if folder == "." else f"kind of data for {folder}"
        raise InputError(unknown_name(what, family, tuple(sorted(there))))
    return there[family]


def load_config(family: str | Path, path: Path | None = None) -> TrackConfig:
    """The defaults shipped for a kind of data, with what a YAML file overrides.

    family  name of a kind of data, or the path of a YAML file over the defaults of "file"; those of "traffic" and
            "dense" are over `dense_traffic_settings`

    Raises `InputError` for an unknown kind, and naming the file and the dotted key of what is wrong in it.
    """
    if isinstance(family, Path):
        config = load_settings(TrackConfig, family, load_config("file"))
    else:
        shipped = shipped_settings(family)
        base = TrackConfig(tracker=dense_traffic_settings()) if family in ("traffic", "dense") else None
        config = read_settings(TrackConfig, shipped.read_text(encoding="utf-8"), shipped.name, base)
    return config if path is None else load_settings(TrackConfig, path, config, OTHER_FILES)
