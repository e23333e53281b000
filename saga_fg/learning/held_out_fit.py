r"""Choice by held-out recordings where learned interactions act: everywhere, on hidden objects, or not at all.

Interactions are fitted (`interaction_fit`) to gaps that begin with estimates of the independent filter. Edges that
always act change the estimates of objects in view too, for better or worse: parked cars that seem to move because the
pose of the vehicle errs move alike; errors of labels that were set one by one have nothing in common. So the recordings
are split into two parts, and rules learned on one are tried by the joint filter (`joint_gaps`) on the other:

    everywhere           edges act as fitted, with the process noise that was fitted with them
    hidden               edges are weighted by their information gain (`EdgeInformation`), low into objects in view
    hidden, filter noise likewise, with the process noise of the independent filter
    nowhere              the independent filter

The form with the least ratio of errors to those of the independent filter, whose ratio is 1, is given to the rules
learned from all recordings. The ratio is the mean over the lengths of the gaps of the larger of two ratios, of the
means and of the medians, so that neither many small nor few large errors decide alone. Each group of classes between
which there are edges has its own form. Classes in no group keep the noise of the independent filter.

A tracker has a process noise of its own, which suits its detections, not the one fitted to true positions. It is
therefore given edges that hardly act on objects in view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from saga_fg.learning.filter_noise import FilterNoise
from saga_fg.learning.gap_prediction import errors_alone
from saga_fg.learning.gaps import GapSample, GapSettings, sample_gaps
from saga_fg.learning.interaction_fit import MOST_GAPS, FittedInteractions, fit_interactions
from saga_fg.learning.joint_gaps import JointGaps
from saga_fg.learning.trajectories import Trajectories
from saga_fg.model.edge_information import EdgeInformation
from saga_fg.model.edge_network import EdgeNetwork
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.numerics.arrays import BoolArray, FloatArray, StrArray

TRIED_GAPS = 40  # of a recording
HIDDEN = EdgeInformation(spread=0.5, unseen_acceleration=2.0)


class Form(NamedTuple):
    """A way in which fitted interactions act: the weighting of edges, and whether the fitted noise is used."""

    information_gain: EdgeInformation | None
    fitted_noise: bool


FORMS = {"everywhere": Form(None, True), "hidden": Form(HIDDEN, True), "hidden, filter noise": Form(HIDDEN, False)}
FORMS_OF_TRACKERS = {"hidden, filter noise": FORMS["hidden, filter noise"]}
INDEPENDENT = "independent"
Rules = tuple[Following | Neighbours | EdgeNetwork, ...]
Fit = Callable[[GapSample, float, Mapping[str, float]], FittedInteractions]
Trial = tuple[StrArray, dict[str, FloatArray]]
"""Labels (n,) of gaps, and their errors (n, S) by form and of the independent filter, m."""


def fit_by_held_out(
    recordings: Sequence[Trajectories],
    classes: tuple[str, ...],
    own: FilterNoise,
    fit: Fit = fit_interactions,
    settings: GapSettings | None = None,
    forms: Mapping[str, Form] = FORMS,
) -> FittedInteractions:
    """Learn interactions from all recordings, and let them act where that lowers errors on recordings held out.

    classes     those that are hidden
    own         process and position noise of the independent filter
    fit         `fit_interactions` or `fit_networks`; raises `InputError` where there is nothing to learn from
    forms       to choose from, besides nowhere; `FORMS_OF_TRACKERS` for trackers, which keep their process noise
    """
    settings = settings or GapSettings()
    fitted = fit(_gaps(recordings, classes, own, settings), own.position_noise, own.acceleration_noise)
    first, second = held_out_parts(recordings)
    trials: list[Trial] = []
    for training, tried in ((first, second), (second, first)):
        sample = _gaps(training, classes, own, settings).sampled(MOST_GAPS // 2, seed=3)
        if len(sample):
            learned = fit(sample, own.position_noise, own.acceleration_noise)
            trials += [_trial(each, learned, classes, own, settings, forms) for each in tried]
    rules: list[Following | Neighbours | EdgeNetwork] = []
    noise = dict(own.acceleration_noise)
    for group in coupled_classes(fitted.rules):
        ratios = {form: _ratio(trials, group, form, own.position_noise) for form in forms}
        form = forms[best := min(ratios, key=lambda each: ratios[each])]
        if ratios[best] < 1:
            rules += [
                replace(rule, information_gain=form.information_gain)
                for rule in fitted.rules
                if group.issuperset(rule.classes)
            ]
            if form.fitted_noise:
                noise |= {label: q for label, q in fitted.acceleration_noise.items() if label in group}
    return replace(fitted, rules=tuple(rules), acceleration_noise=noise)


def held_out_parts(recordings: Sequence[Trajectories]) -> tuple[list[Trajectories], list[Trajectories]]:
    """Every other recording and the rest; the halves of a single one."""
    if len(recordings) > 1:
        return list(recordings[0::2]), list(recordings[1::2])
    (only,) = recordings
    half = len(only) // 2
    return [only.moments(slice(half))], [only.moments(slice(half, None))]


def coupled_classes(rules: Rules) -> list[set[str]]:
    """Groups of classes; there are no edges between one and another."""
    groups: list[set[str]] = []
    for rule in rules:
        mine = set(rule.classes)
        touched = [group for group in groups if group & mine]
        groups = [group for group in groups if group not in touched] + [mine.union(*touched)]
    return groups


def _gaps(
    recordings: Sequence[Trajectories], classes: tuple[str, ...], own: FilterNoise, settings: GapSettings
) -> GapSample:
    return GapSample.concatenate(
        [sample_gaps(each, own.filtered(each), classes, settings, k) for k, each in enumerate(recordings)]
    )


def _trial(
    of: Trajectories,
    learned: FittedInteractions,
    classes: tuple[str, ...],
    own: FilterNoise,
    settings: GapSettings,
    forms: Mapping[str, Form],
) -> Trial:
    filtered = own.filtered(of)
    gaps = sample_gaps(of, filtered, classes, settings).sampled(TRIED_GAPS, seed=2)
    errors = {INDEPENDENT: errors_alone(gaps)}
    for name, form in forms.items():
        rules = [replace(rule, information_gain=form.information_gain) for rule in learned.rules]
        noise = learned.acceleration_noise if form.fitted_noise else own.acceleration_noise
        joint = JointGaps(of, filtered, noise, own.position_noise, rules, learned.explained_noise)
        errors[name] = joint.errors(gaps, settings)
    return gaps.label, errors


def _ratio(trials: Sequence[Trial], group: set[str], form: str, position_noise: float) -> float:
    """Errors of a form against the independent filter's, see the module; 1 without trials."""
    ratios = []
    for step in range(max((errors[form].shape[1] for _, errors in trials), default=0)):
        pairs = [
            (errors[form][known, step], errors[INDEPENDENT][known, step])
            for label, errors in trials
            if step < errors[form].shape[1] and (known := _known(label, errors, group, form, step)).any()
        ]
        if pairs:
            mine, independent = (np.concatenate(each) for each in zip(*pairs, strict=True))
            ratios.append(
                max(  # differences below the position noise do not count
                    float((average(mine) + position_noise) / (average(independent) + position_noise))
                    for average in (np.mean, np.median)
                )
            )
    return float(np.mean(ratios)) if ratios else 1.0


def _known(label: StrArray, errors: Mapping[str, FloatArray], group: set[str], form: str, step: int) -> BoolArray:
    finite = np.isfinite(errors[form][:, step]) & np.isfinite(errors[INDEPENDENT][:, step])
    return np.asarray(finite & np.isin(label, list(group)))
