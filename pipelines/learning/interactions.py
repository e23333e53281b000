"""Interactions learned from recordings, in the form that does best in gaps of recordings held out.

Runs of a tracker through gaps that are made in recordings are judged gap by gap. Labels and tracks that were detected
at the moment are matched one to one (`data_tools.metrics.scene`). An object is *held* by the track it was matched to
last, at most `SETTLING` s ago. That track, which is kept alive while it has no detections, is compared with the label:
its error, m, which is `CAP` where it is not known or farther away.

Edge rules can act in several forms, which differ in what they do to objects in view, whose detections say more than
their neighbours. So the recordings are split into two parts, and every form, fitted to one part, tracks the other
with made gaps, on the tracker's own configuration:

    everywhere   edges act as fitted
    hidden       edges are weighted by their information gain, low into objects in view, and fitted with it
    refitted     the rules of the configuration, fitted
    shipped      the rules of the configuration
    nowhere      none of these

The base motion is the tracker without rules that can be learned: trails, lights and lines stay, as they do beside the
rules of a file. The form of the least ratio of errors to those of the base motion, whose ratio is 1, is fitted to all
recordings and written: a tracker given the file is the tracker that was tried. The ratio is the mean over the lengths
of the gaps of the larger of two ratios, of the means and of the medians, so that neither many small nor few large
errors decide alone.
Each group of classes between which there are edges has its own form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf
from typing import Any, TypeVar

import numpy as np

from data_tools.datasets import DatasetSource, detected, true_scene
from data_tools.figures import FigureTable, cell
from data_tools.metrics.scene import match_scene
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, track_scene
from saga_fg.errors import InputError
from saga_fg.learning import (
    FOLLOWED,
    LENGTHS,
    LONGEST,
    TEMPLATE,
    Gap,
    HiddenObjects,
    LabelledScene,
    Rule,
    fit_interactions,
    hidden_objects,
    made_gaps,
    reached,
)
from saga_fg.model import AccelerationLaw, Following, LearnedInteractions, Neighbours, Sensor
from saga_fg.numerics import FloatArray
from saga_fg.types import DEFAULT, Annotations, Frame, Scene, Tracks

SETTLING = 0.6  # s: for so long a returning object may wait for its identity
DETECTED = 0.15  # s: a track counts as detected for so long, as sensors don't measure at the moments of labels
CAP = 10.0  # m
GATE = 2.0  # m, between a label and its track
LIFE = LONGEST + 1.0  # s: for so long tracks live without a detection

Errors = Mapping[float, float]
"""Position errors, m, by time since the last detection, s, of one gap."""
A = TypeVar("A")
B = TypeVar("B")


class JudgedRun:
    """A run's tracks (K,) at the moments of a labelled scene.

    track_of  for each moment, the detected track of each object that has one, by its name
    """

    def __init__(self, labelled: LabelledScene, tracks: Sequence[Tracks]) -> None:
        self.labelled, self.tracks = labelled, tracks
        truth = labelled.scene.ground_truth or ()
        self.detected = [found.select(found.coasting <= DETECTED) for found in tracks]
        self.track_of: list[dict[str, int]] = []
        for moment, found, match in zip(truth, self.detected, match_scene(truth, self.detected, GATE), strict=True):
            pairs = (moment.id[match.object_row].tolist(), found.id[match.track_row].tolist())
            self.track_of.append(dict(zip(*pairs, strict=True)))
        self.row_of = [{name: row for row, name in enumerate(found.id.tolist())} for found in tracks]

    def outcome(self, gap: Gap) -> Errors:
        """Judge one gap."""
        ends, holder = reached(self.labelled.scene.timestamps, gap), self.holder(gap)
        if holder is None:
            return dict.fromkeys(ends, CAP)
        errors = {length: self.error(holder, gap.row, k) for length, k in ends.items()}
        return {length: error for length, error in errors.items() if np.isfinite(error)}

    def holder(self, gap: Gap) -> int | None:
        """The track that held the object before the gap."""
        return self.last(self.track_of, str(self.labelled.id[gap.row]), gap.start, back=True)

    def last(self, of: Sequence[Mapping[A, B]], one: A, moment: int, back: bool) -> B | None:
        """The last partner within `SETTLING` s until a moment (`back`), or from it on."""
        after = (self.labelled.scene.timestamps - self.labelled.scene.timestamps[moment]) * (-1 if back else 1)
        near = np.flatnonzero((after >= 0) & (after <= SETTLING))
        return next((of[k][one] for k in near[::-1].tolist() if one in of[k]), None)

    def error(self, track: int, row: int, moment: int) -> float:
        """The error of a track at a moment, NaN where the object is not labelled."""
        truth = self.labelled.position[moment, row]
        if not np.isfinite(truth[0]):
            return float("nan")
        there = self.position(track, moment)
        return CAP if there is None else min(float(np.hypot(*(there - truth))), CAP)

    def position(self, track: int, moment: int) -> FloatArray | None:
        """The place (2,) of a track, None where it is not among the results."""
        row = self.row_of[moment].get(track)
        return None if row is None else np.asarray(self.tracks[moment].boxes.position[row, :2])


@dataclass(frozen=True)
class Contender:
    """A method with its configuration."""

    name: str
    method: Method
    config: TrackConfig

    def kept_alive(self) -> Contender:
        """The contender whose tracks live, and are reported, for as long as any gap."""
        config, own = self.config, self.config.tracker
        tracker = replace(
            own,
            report_coasting=inf,
            report_out_of_view=True,
            max_coasting=LIFE,
            classes={label: replace(each, max_deviation=inf) for label, each in own.classes.items()},
            existence=replace(own.existence, delete_below=0.0, report_above=0.0),
        )
        greedy = replace(config.greedy, max_coasting=LIFE)
        return replace(self, config=replace(config, tracker=tracker, greedy=greedy))


@dataclass(frozen=True)
class Run:
    """A contender's errors in the gaps of one recording, with the class of the object of each gap."""

    recording: str
    contender: str
    gaps: tuple[Gap, ...]
    label: tuple[str, ...]
    outcomes: tuple[Errors, ...]


def judged_on(
    scenes: Mapping[str, Scene],
    contenders: Sequence[Contender],
    passes: int,
    seed: int,
    progress: Progress | None = None,
) -> list[Run]:
    """Runs of all contenders, whose sensors are the same, on recordings with made gaps, tracks kept alive."""
    runs: list[Run] = []
    for name, scene in scenes.items():
        labelled = LabelledScene.from_scene(scene, contenders[0].config.sensors)
        gaps = made_gaps(labelled, passes, seed)
        for contender in contenders:
            outcomes: dict[int, Errors] = {}
            for number in sorted({gap.run for gap in gaps}):
                mine = {k: gap for k, gap in enumerate(gaps) if gap.run == number}
                run = JudgedRun(labelled, tracks_without(labelled, list(mine.values()), contender.kept_alive()))
                outcomes |= {k: run.outcome(gap) for k, gap in mine.items()}
            ordered = tuple(outcomes[k] for k in range(len(gaps)))
            runs.append(Run(name, contender.name, tuple(gaps), classes_of(labelled, gaps), ordered))
            if progress is not None:
                progress(f"held out {name} {contender.name}", len(runs), len(scenes) * len(contenders))
    return runs


def classes_of(labelled: LabelledScene, gaps: Sequence[Gap]) -> tuple[str, ...]:
    """The class of the object of each gap."""
    return tuple(str(labelled.label[gap.row]) for gap in gaps)


def tracks_without(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender) -> Sequence[Tracks]:
    """A contender's tracks without the detections of some gaps."""
    scene = replace(labelled.scene, frames=hidden(labelled, gaps) if gaps else labelled.scene.frames)
    return track_scene(scene, contender.config.new_tracker(contender.method)).tracks


def hidden(labelled: LabelledScene, gaps: Sequence[Gap]) -> list[Frame]:
    """The frames without the detections of some gaps."""
    time = labelled.scene.timestamps
    start = np.array([time[gap.start] for gap in gaps])
    stop = np.array([time[gap.stop] for gap in gaps])
    return labelled.frames_without(np.array([gap.row for gap in gaps]), start, stop)


BASE, SHIPPED, LEARNED = "base motion", "shipped edges", "learned edges"
NOWHERE = "nowhere"
SEED = 0  # of the choice of made gaps
PLACE_NOISE = 0.1  # m: differences below it do not count
Rules = tuple[Rule, ...]


@dataclass(frozen=True, eq=False)
class LearnedForms:
    """The learned interactions; the form of each group of classes; runs on recordings held out, of three contenders.

    held_out   what each recording that was held out was judged with
    ratios     of each group: form -> ratio of its errors to those of the base motion
    """

    interactions: LearnedInteractions
    forms: Mapping[tuple[str, ...], str]
    ratios: Mapping[tuple[str, ...], Mapping[str, float]]
    runs: tuple[Run, ...]
    held_out: Mapping[str, LearnedInteractions]


@dataclass(frozen=True, eq=False)
class _Part:
    """Recordings that are held out, with all forms fitted to the others: group -> form -> rules."""

    tested: Mapping[str, Scene]
    rules: Mapping[tuple[str, ...], Mapping[str, Rules]]


def learn_interactions(
    scenes: Mapping[str, Scene],
    origin: str,
    config: TrackConfig,
    start: LearnedInteractions | None = None,
    passes: int = 2,
    progress: Progress | None = None,
) -> LearnedForms:
    """Learn from annotated scenes with detections; `origin` says in the file where from.

    config   of the tracker: its motion, turns and stationarity are the base on which edges are learned
    start    rules from which the search begins, in place of the forms of the template
    passes   number of times that each recording held out is tracked, each time with other made gaps

    Raises `InputError` where no object is followed for long enough.
    """
    gaps: dict[str, HiddenObjects | None] = {}
    for done, (name, scene) in enumerate(scenes.items()):
        gaps[name] = hidden_objects(scene, config.tracker, config.sensors)
        if progress is not None:
            progress(f"base motion {name}", done + 1, len(scenes))
    if not any(gaps.values()):
        raise InputError(f"{origin}: expected objects that are followed for {FOLLOWED:g} s and more")
    shipped = tuple(rule for rule in config.tracker.edges if isinstance(rule, Following | Neighbours))
    templates = _forms(shipped) if start is None else {"refitted": start.edges}
    groups = coupled_classes([*shipped, *(rule for rules in templates.values() for rule in rules)])

    def fitted(names: Sequence[str], forms: Mapping[str, Rules], group: tuple[str, ...]) -> dict[str, Rules]:
        parts = [part for name in names if (part := gaps[name]) is not None]
        sample = HiddenObjects.pooled(parts) if parts else None
        mine = None if sample is None else sample.select(np.flatnonzero(np.isin(sample.label, group)))
        if mine is None or len(mine) == 0:
            return {}
        found: dict[str, Rules] = {}
        for done, (form, rules) in enumerate(forms.items()):
            if own := _of_group(rules, group):
                found[form] = fit_interactions(mine, config.tracker, own).rules
            if progress is not None:
                progress(f"fit {form}, {group[0]}, ...", done + 1, len(forms))
        return found

    first, second = held_out_parts(scenes)
    parts = [
        _Part(tested, {group: fitted(tuple(taught), templates, group) for group in groups})
        for taught, tested in ((first, second), (second, first))
    ]
    trials = _trials(parts, config, origin, passes, progress)
    ratios, chosen = {}, {}
    for group in groups:
        ratios[group] = {form: _ratio(runs, trials[BASE], group) for form, runs in trials.items() if form != BASE}
        best = min(ratios[group], key=lambda form: ratios[group][form], default=NOWHERE)
        chosen[group] = best if ratios[group].get(best, 1.0) < 1 else NOWHERE

    def combined(fits: Mapping[tuple[str, ...], Mapping[str, Rules]], what: str) -> LearnedInteractions:
        rules: list[Rule] = []
        for group, form in chosen.items():
            rules += _of_group(shipped, group) if form == SHIPPED else fits.get(group, {}).get(form, ())
        return LearnedInteractions(
            learned_from=what, edges=tuple(rules), explained_noise=config.tracker.explained_noise
        )

    held_out = {name: combined(part.rules, origin) for part in parts for name in part.tested}
    runs = [run for form in (BASE, SHIPPED) for run in trials[form]]
    forms = {BASE if form == NOWHERE else form for form in chosen.values()}
    tried = trials.get(forms.pop(), []) if len(forms) == 1 else []
    if len(tried) == len(trials[BASE]):  # all groups have the form of these runs
        runs += [replace(run, contender=LEARNED) for run in tried]
    else:
        for part in parts:
            if part.tested:
                learned = Contender(LEARNED, "saga", config.with_interactions(combined(part.rules, origin)))
                runs += judged_on(part.tested, [learned], passes, SEED, progress)
    everything = {
        group: fitted(tuple(scenes), {form: templates[form]}, group)
        for group, form in chosen.items()
        if form in templates
    }
    return LearnedForms(combined(everything, origin), chosen, ratios, tuple(runs), held_out)


def held_out_parts(scenes: Mapping[str, Scene]) -> tuple[dict[str, Scene], dict[str, Scene]]:
    """The first and the second half of the recordings, as neighbours in order are often of one place and time.

    The halves of a single one, by time.
    """
    names = list(scenes)
    if len(names) > 1:
        half = (len(names) + 1) // 2
        return {name: scenes[name] for name in names[:half]}, {name: scenes[name] for name in names[half:]}
    (only,) = scenes.values()
    middle = len(only) // 2
    return {only.name: _part_of(only, slice(None, middle))}, {only.name: _part_of(only, slice(middle, None))}


def coupled_classes(rules: Sequence[Rule]) -> list[tuple[str, ...]]:
    """Groups of classes; there are no edges between one and another."""
    groups: list[set[str]] = []
    for rule in rules:
        mine = set(rule.classes)
        touched = [group for group in groups if group & mine]
        groups = [group for group in groups if group not in touched] + [mine.union(*touched)]
    return [tuple(sorted(group)) for group in groups]


def _forms(shipped: Rules) -> dict[str, Rules]:
    return {
        "everywhere": TEMPLATE,
        "hidden": tuple(replace(rule, information_gain=True) for rule in TEMPLATE),
        "refitted": tuple(rule for rule in shipped if not isinstance(rule.interaction, AccelerationLaw)),
    }


def _of_group(rules: Sequence[Rule], group: Sequence[str]) -> Rules:
    return tuple(rule for rule in rules if set(rule.classes) <= set(group))


def _trials(
    parts: Sequence[_Part],
    config: TrackConfig,
    origin: str,
    passes: int,
    progress: Progress | None,
) -> dict[str, list[Run]]:
    """The runs of every form on the recordings held out, by form."""
    found: dict[str, list[Run]] = {BASE: [], SHIPPED: []}
    for part in parts:
        if not part.tested:
            continue
        contenders = [Contender(SHIPPED, "saga", config)]
        for form in (BASE, *dict.fromkeys(form for rules in part.rules.values() for form in rules)):
            rules = tuple(rule for own in part.rules.values() for rule in own.get(form, ()))
            learned = LearnedInteractions(
                learned_from=origin, edges=rules, explained_noise=config.tracker.explained_noise
            )
            contenders.append(Contender(form, "saga", config.with_interactions(learned)))
        for run in judged_on(part.tested, contenders, passes, SEED, progress):
            found.setdefault(run.contender, []).append(run)
    return found


def _ratio(runs: Sequence[Run], base: Sequence[Run], group: Sequence[str]) -> float:
    """Errors of a form against those of the base motion, see the module; 1 without gaps."""
    tried = {run.recording for run in runs}
    mine, other = _errors(runs, group), _errors([run for run in base if run.recording in tried], group)
    ratios = []
    for length in LENGTHS:
        both = [(a[length], b[length]) for a, b in zip(mine, other, strict=True) if length in a and length in b]
        if both:
            a, b = np.array(both).T
            averages = (np.mean, np.median)
            ratios.append(max(float((f(a) + PLACE_NOISE) / (f(b) + PLACE_NOISE)) for f in averages))
    return float(np.mean(ratios)) if ratios else 1.0


def _errors(runs: Sequence[Run], group: Sequence[str]) -> list[Errors]:
    """The errors by length of all made gaps of the classes of a group."""
    return [
        outcome
        for run in runs
        for gap, label, outcome in zip(run.gaps, run.label, run.outcomes, strict=True)
        if gap.run > 0 and label in group
    ]


def _part_of(scene: Scene, kept: slice) -> Scene:
    """The moments of a scene, with the frames of their time."""
    time = scene.timestamps[kept]
    assert scene.ground_truth is not None
    frames = [f for f in scene.frames if len(time) and time[0] - 1e-6 <= f.timestamp <= time[-1] + 1e-6]
    poses, truth = scene.world_T_ego[kept], scene.ground_truth[kept]
    return Scene(scene.name, time, poses, scene.tokens[kept], frames, truth)


def scenes_to_learn_from(source: DatasetSource, config: TrackConfig, with_truth: bool) -> dict[str, Scene]:
    """Scenes by name. With the truth, what is annotated and visible is detected, by the only sensor that the
    configuration has a model of. Without it, the tracks of the tracker without edges stand for the truth.

    Raises `InputError` for what cannot be read.
    """
    if with_truth:
        with source.open(truth=True) as dataset:
            return {name: _detected(true_scene(dataset, name), config) for name in dataset.scenes}
    with source.open() as dataset:
        scenes = [dataset.scene(name) for name in dataset.scenes]
    return {scene.name: _with_tracks(scene, track_scene(scene, config.new_tracker("kf")).tracks) for scene in scenes}


def _detected(scene: Scene, config: TrackConfig) -> Scene:
    frames, named = detected(scene), [name for name in config.sensors if name != DEFAULT]
    if len(named) == 1 and config.sensors.get(DEFAULT, Sensor()) == Sensor():
        frames = [replace(frame, sensor=named[0]) for frame in frames]
    return replace(scene, frames=frames)


def _with_tracks(scene: Scene, tracks: Sequence[Tracks]) -> Scene:
    seen = [moment.select(moment.coasting == 0) for moment in tracks]
    truth = [Annotations(each.id.astype(np.str_), each.boxes) for each in seen]
    return replace(scene, ground_truth=truth)


TITLE = "recordings held out"


def held_out_errors(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The errors of each contender, m, at each time after the start of made gaps; that of a lost track is `CAP`."""
    rows = []
    for length, contender in product(LENGTHS, dict.fromkeys(run.contender for run in runs)):
        mine = [outcome for run in runs if run.contender == contender for outcome in run.outcomes]
        errors = np.array([outcome[length] for outcome in mine if length in outcome])
        if len(errors):
            figures = {"gaps": len(errors), "mean": float(errors.mean()), "median": float(np.median(errors))}
            rows.append({"length": length, "contender": contender, **figures})
    return rows


def learned_tables(learned: LearnedForms) -> list[FigureTable]:
    """The forms that were tried, and the errors in the gaps of recordings held out."""
    rows = tuple(
        (", ".join(group), form, cell(ratio, 3), "written" if form == learned.forms[group] else "")
        for group, ratios in learned.ratios.items()
        for form, ratio in ratios.items()
    )
    columns = ("classes", "form", f"errors / those of the {BASE}", "")
    errors = tuple(
        (f"{row['length']:g} s, {row['contender']}", cell(row["gaps"]), cell(row["mean"]), cell(row["median"]))
        for row in held_out_errors(learned.runs)
    )
    tables = (
        FigureTable(f"{TITLE}: forms of the edges", columns, rows),
        FigureTable(f"{TITLE}: errors after", ("after", "gaps", "mean, m", "median, m"), errors),
    )
    return [table for table in tables if table.rows]


def learned_figures(learned: LearnedForms) -> dict[str, Any]:
    """For programs: what the tables show."""
    return {
        "forms": [
            {"classes": group, "form": learned.forms[group], "ratios": ratios}
            for group, ratios in learned.ratios.items()
        ],
        "errors": held_out_errors(learned.runs),
    }
