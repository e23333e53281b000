"""`python -m benchmarks gaps` on simulated traffic."""

import dataclasses
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import gaps as bench
from benchmarks.app import app
from benchmarks.gaps import GapBenchSettings, GapErrors, gap_figures
from saga_fg.errors import InputError
from saga_fg.learning import FittedInteractions, Trajectories, filter_independently, sample_gaps
from saga_fg.model.edge_rules import Following
from saga_fg.model.interactions import CarFollowing
from tests.saga_fg.following_pairs import RATE, following_pairs


def test_figures_are_those_of_the_errors_at_the_end_of_each_gap():
    kf = np.tile([1.0, 2.0, 4.0, np.nan, np.nan, np.nan], (40, 1))
    kf[:, 5] = 8.0
    errors = GapErrors(
        np.zeros(40, dtype=np.int64),
        np.arange(40) // 4,
        np.where(np.arange(40) < 20, "car", "pedestrian"),
        np.arange(40) % 2 == 0,
        0.5 * np.arange(1, 7),
        {"kf": kf, "learned": 0.5 * kf},
    )
    rows = {(row.label, row.gap, row.method): row for row in gap_figures(errors)}
    groups = {"car": 20, "pedestrian": 20, "pedestrian with companions": 10}
    assert set(rows) == {(g, gap, method) for g in groups for gap in (1.0, 3.0) for method in ("kf", "learned")}
    assert {row.label: row.gaps for row in rows.values()} == groups
    assert rows["car", 1.0, "kf"].median == 2.0
    assert rows["car", 3.0, "learned"].mean == 4.0
    assert rows["car", 3.0, "learned"].mean_change.estimate == -0.5
    assert rows["car", 1.0, "kf"].mean_change is None


def test_the_length_of_a_gap_is_that_of_its_steps():
    error = np.ones((4, 3))
    none = np.zeros(4, dtype=np.int64)
    errors = GapErrors(none, none, np.full(4, "car"), none > 0, 0.4 * np.arange(1, 4), {"kf": error})
    assert errors.at(1.0)[0] == pytest.approx(0.8)
    assert errors.at(3.0)[0] == pytest.approx(1.2)


def test_who_walks_beside_another_is_with_companions():
    moments, walking = 30, np.array([1.2, 0.0])
    start = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 10.0], [1.0, 9.0]])
    velocity = np.array([walking, walking, walking, -walking])
    time = 0.4 * np.arange(moments)
    position = start + time[:, None, None] * velocity
    heading = np.arctan2(velocity[:, 1], velocity[:, 0]) + np.zeros((moments, 4))
    people = Trajectories(time, np.array(list("abcd")), np.full(4, "pedestrian"), np.zeros(4), position, heading)
    filtered = filter_independently(people, np.full(4, 0.1), 0.05)
    gaps = sample_gaps(people, filtered, ("pedestrian",))
    assert (bench._with_companions(gaps) == (gaps.row < 2)).all()
    assert len(gaps) > 10


def test_a_recording_is_judged_by_what_the_others_taught(monkeypatch):
    """Drawn pairs, whose cars follow as the rule says that takes the place of what is learned."""
    rule, taught_by = Following(CarFollowing(time_constant=math.inf), rate=RATE, gap_scale=100.0), []

    def fit(recordings, classes, own, fit, settings):
        taught_by.append([id(each) for each in recordings])
        return FittedInteractions((rule,), own.acceleration_noise, 0.0, 0.0)

    monkeypatch.setattr(bench, "fit_by_held_out", fit)
    recordings = {str(seed): following_pairs(pairs=2, moments=80, seed=seed) for seed in range(2)}
    errors, learned = bench.gap_errors(recordings, ("car",), ())
    first, second = map(id, recordings.values())
    assert taught_by == [[second], [first]], "no fold is tested on what it was fitted to"
    assert len(learned["learned"]) == 2
    np.testing.assert_allclose(
        errors.errors["hand-crafted"], errors.errors["kf"], atol=1e-6, err_msg="no rules: independent objects"
    )
    np.testing.assert_allclose(errors.errors["noise alone"], errors.errors["kf"], err_msg="that of kf, here")
    _, at = errors.at(2.0)
    kf, ours = at.errors["kf"], at.errors["learned"]
    assert len(kf) > 20
    assert ours.mean() < 0.9 * kf.mean()


def test_networks_are_judged_beside_the_rest_where_they_are_asked_for(monkeypatch):
    def nothing(sample, position_noise, acceleration_noise):
        return FittedInteractions((), acceleration_noise, 0.0, 0.0)

    for fit in ("fit_interactions", "fit_networks"):
        monkeypatch.setattr(bench, fit, nothing)
    recordings = {str(seed): following_pairs(pairs=1, moments=50, seed=seed) for seed in range(2)}
    settings = GapBenchSettings(network=True, tested_folds=1)
    errors, learned = bench.gap_errors(recordings, ("car",), (), settings)
    assert list(errors.errors) == ["kf", "hand-crafted", "learned", "network", "noise alone"]
    assert {method: len(found) for method, found in learned.items()} == {"learned": 1, "network": 1}
    assert set(errors.recording.tolist()) == {0}
    np.testing.assert_allclose(errors.errors["network"], errors.errors["kf"], atol=1e-6)


def test_recordings_in_which_nobody_is_followed_are_named():
    recordings = {name: following_pairs(pairs=1, moments=5) for name in ("first", "second")}
    with pytest.raises(InputError, match="recordings second: expected some car, followed for 1 s"):
        bench.gap_errors(recordings, ("car",), ())


def test_recordings_of_unlike_rates_are_refused():
    slow = following_pairs(pairs=1, moments=60)
    slow = dataclasses.replace(slow, time=7 * slow.time)
    with pytest.raises(InputError, match=r"recording slow: expected .* steps of 0\.5 s as in quick, got 0\.7 s"):
        bench.gap_errors({"quick": following_pairs(pairs=1), "slow": slow}, ("car",), ())


def test_the_command_refuses_what_it_cannot_judge_by(tmp_path):
    out = tmp_path / "gaps.json"
    result = CliRunner().invoke(app, ["gaps", "--data", "file=x.csv"])
    assert result.exit_code == 2
    assert "recordings with ground truth" in result.output
    result = CliRunner().invoke(app, ["gaps", "--data", "simulated=1", "--json", str(out)])
    assert result.exit_code == 2
    assert "at least two recordings" in result.output
    assert not out.exists()
