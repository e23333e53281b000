"""Predictions judged against the truth: whose track, where it was then, errors, likelihoods and ellipses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.predictions import HORIZONS, PredictionErrors, PredictionRecorder, prediction_figures
from data_tools.metrics import Interval
from saga_fg import Annotations, Boxes, PredictedTracks, Scene, Tracker, Tracks
from saga_fg.numerics.arrays import FloatArray


def boxes(position: list[tuple[float, float]]) -> Boxes:
    n = len(position)
    return Boxes.of(["car"] * n, [(x, y, 0.0) for x, y in position], [(4.5, 1.9, 1.6)] * n, [0.0] * n)


def truth(times: FloatArray) -> Scene:
    """A car at 10 m/s, a parked one, and one that is labelled for two seconds alone."""
    moments = []
    for t in times.tolist():
        names, places = ["mover", "parked"], [(10.0 * t, 0.0), (0.0, 50.0)]
        if t < 2.05:
            names, places = [*names, "brief"], [*places, (0.0, -50.0)]
        moments.append(Annotations(np.array(names), boxes(places), np.ones(len(names), dtype=np.bool_)))
    return Scene("made", times, np.tile(np.eye(4), (len(times), 1, 1)), ("",) * len(times), [], moments)


class Foreseeing(Tracker):
    """Predicts two tracks, 3 m ahead of where they will be and 0.5 m beside, with a standard deviation of 2 m."""

    asked: int = 0

    def predict(self, horizons: object, joint: bool = False) -> PredictedTracks:
        self.asked += 1
        h = np.asarray(horizons, dtype=np.float64)
        position = np.zeros((len(h), 2, 2))
        position[:, 0] = np.stack([10 * (1.0 + h) + 3.0, 0 * h], axis=-1)
        position[:, 1] = (0.5, 50.0)
        P = np.tile(4.0 * np.eye(2), (len(h), 2, 1, 1))
        none = np.zeros_like(position)
        return PredictedTracks(1.0, h, np.array([4, 7]), np.array(["car"] * 2), position, none, none[..., 0], P, P)


def reported(timestamp: float, coasting: tuple[float, float] = (0.0, 0.0)) -> Tracks:
    P = np.tile(np.eye(2), (2, 1, 1))
    now = boxes([(10 * timestamp + 0.2, 0.0), (0.3, 50.0)])
    return Tracks(timestamp, np.array([4, 7]), now, np.ones(2), P, P, np.array(coasting))


def test_errors_are_those_of_the_tracks_of_visible_objects_where_labels_reach() -> None:
    recorder, tracker = PredictionRecorder(), Foreseeing()
    recorder.after(tracker, reported(1.0))
    found = recorder.errors(truth(np.arange(0, 4.6, 0.5)))  # labels end after 4.5 s: 5 s ahead nobody knows
    assert found.horizon.tolist() == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    assert found.error == pytest.approx([3.0, 0.5] * 3)
    assert found.nees == pytest.approx([9 / 4, 0.25 / 4] * 3)
    assert found.nll == pytest.approx((found.nees + 2 * math.log(2 * math.pi * 4.0)) / 2)
    assert found.moving.tolist() == [True, False] * 3


def test_hidden_tracks_and_gaps_of_labels_are_left_out_and_times_between_labels_are_joined() -> None:
    recorder, tracker = PredictionRecorder(), Foreseeing()
    recorder.after(tracker, reported(1.0, coasting=(0.5, 0.0)))
    between = recorder.errors(truth(np.array([0.0, 1.0, 1.7, 2.3, 7.0])))
    assert between.horizon.tolist() == [1.0], "2, 3 and 5 s ahead are in a gap of 4.7 s"
    assert between.error == pytest.approx([0.5])


def test_predictions_are_asked_for_once_a_second() -> None:
    recorder, tracker = PredictionRecorder(), Foreseeing()
    for t in np.arange(0, 3.05, 0.1).tolist():
        recorder.after(tracker, reported(t))
    assert tracker.asked == 4


def test_figures_by_horizon_and_motion() -> None:
    def errors(scale: float) -> PredictionErrors:
        nees = np.array([0.1, 2.0, 4.0, 9.0])
        return PredictionErrors(np.full(4, 2.0), scale * np.arange(1.0, 5.0), nees, nees, np.array([True, False] * 2))

    found = prediction_figures({"kf": [errors(1.0)] * 3, "saga": [errors(0.5)] * 3}, "kf", [[0], [1], [2]])
    assert [(f.moving, f.horizon, f.method, f.predictions) for f in found] == [
        (False, 2.0, "kf", 12),
        (False, 2.0, "saga", 12),
        (True, 2.0, "kf", 6),
        (True, 2.0, "saga", 6),
    ]
    assert [f.error for f in found] == [2.5, 1.25, 2.0, 1.0]
    assert found[0].change is None
    assert found[1].change is not None
    assert found[1].change.estimate == pytest.approx(-0.5)
    assert found[0].coverage == {0.5: 0.25, 0.9: 0.75}  # within 1.39 and 4.61
    assert found[0].nll == pytest.approx(3.775)
    assert prediction_figures({"kf": []}, "kf", []) == []
    assert max(HORIZONS) == 5.0


def test_scenes_that_overlap_are_drawn_together_and_two_units_have_no_interval() -> None:
    def errors(error: float) -> PredictionErrors:
        one = np.ones(1)
        return PredictionErrors(one, error * one, one, one, np.array([False]))

    def change(scenes: int, units: list[list[int]]) -> Interval:
        methods = {"kf": [errors(1.0)] * scenes, "saga": [errors(0.5), errors(1.5)] * (scenes // 2)}
        found = prediction_figures(methods, "kf", units)[1].change
        assert found is not None
        assert found.estimate == pytest.approx(0.0)
        return found

    apart, together = change(6, [[row] for row in range(6)]), change(6, [[0, 1], [2, 3], [4, 5]])
    assert apart.low < -0.1 < 0.1 < apart.high
    assert (together.low, together.high) == pytest.approx((0.0, 0.0)), "the units are alike"
    few = change(4, [[0, 1], [2, 3]])
    assert np.isnan([few.low, few.high]).all()
