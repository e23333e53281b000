"""The estimators' benchmark in miniature: it measures what it says, everybody is exact, its figures can be read."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.contenders import GtsamWindow, Ours, OurWindow, Textbook
from benchmarks.estimator_figures import Row, Soak, criteria, exponents
from benchmarks.estimators import KINDS, EstimatorBenchSettings, bench_estimators
from benchmarks.flocks import flock
from benchmarks.measuring import size_of
from benchmarks.running_graph import Vehicles
from saga_fg import InputError
from saga_fg.estimators import IncrementalSmoother, JointKalmanFilter
from saga_fg.graph import OBJECT

TINY = EstimatorBenchSettings(
    sizes=(4, 8), frames=2, batch_frames=4, batch_nodes=6, soak_frames=20, soak_nodes=5, scenes=2, scene_frames=5
)


@pytest.fixture(scope="module")
def result():
    return bench_estimators(TINY)


def test_every_exact_estimator_is_exact(result) -> None:
    ours = [row for row in result.rows if row.contender in ("kalman", "isam2", "fixed-lag", "batch")]
    assert {(row.case, row.contender) for row in ours} == {
        ("filter", "kalman"),
        ("filter", "isam2"),
        ("fixed lag", "fixed-lag"),
        ("batch", "batch"),
    }
    for row in ours:
        assert row.largest_error < 1e-9
        assert row.covariance_error < 1e-9
        assert row.average_error <= row.largest_error


def test_ratios_are_those_of_the_times(result) -> None:
    for row in result.rows:
        textbook = dict.fromkeys(("filter", "batch"), "textbook")
        others = {"fixed lag": "GTSAM's", "running graph": "linear", "nonlinear": "whole graph"}
        baseline = (textbook | others)[row.case]
        (base,) = [
            other
            for other in result.rows
            if (other.case, other.graph, other.nodes, other.contender) == (row.case, row.graph, row.nodes, baseline)
        ]
        assert row.ratio == pytest.approx(row.milliseconds / base.milliseconds)
        assert row.milliseconds > 0


def test_the_endurance_run_tells_its_start_and_end(result) -> None:
    told = [(soak.contender, soak.graph, soak.frames) for soak in result.soaks]
    assert told == [("isam2", "connected", 20), ("isam2", "components", 20), ("drivers", "components", 20)]
    for soak in result.soaks:
        assert min(soak.milliseconds) > 0
        assert min(soak.memory) > 1


def test_the_running_graph_is_measured_on_what_is_nonlinear(result) -> None:
    drivers = {(row.graph, row.contender) for row in result.rows if row.case == "running graph" and row.nodes == 8}
    assert drivers == {(kind, name) for kind in KINDS for name in ("linear", "intelligent driver")}
    whole, window = (row for row in result.rows if row.case == "nonlinear")
    assert math.isnan(whole.largest_error)
    assert window.largest_error >= window.average_error >= 0
    assert whole.band == window.band
    assert window.band[0] < 1 < window.band[1]


def test_vehicles_take_each_others_places() -> None:
    """One place after the other gets a new vehicle; those behind it go on behind that one."""
    smoother, vehicles = IncrementalSmoother(), Vehicles(10, 5, life=10)
    seen: set[int] = set()
    for k in range(25):
        smoother.step(0.1 * k, [vehicles])
        there = smoother.graph().of(OBJECT, k)
        new = there.keys() - seen
        assert len(there) == 10
        assert len(new) == (10 if k == 0 else 1)
        seen |= new
        places = np.stack([smoother.state(there[i].key)[:2] for i in vehicles.ids(k).tolist()])
        expected = vehicles.start[:, :2] + [0.8 * k, 0.0]
        assert np.abs(places - expected).max() < 3.0


def test_the_command_prints_tables_and_writes_figures(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    sizes = "--sizes 4 --frames 1 --batch-frames 2 --batch-nodes 4 --soak-frames 10 --soak-nodes 4 --scenes 1"
    run = CliRunner().invoke(app, ["estimators", *sizes.split(), "--json", str(path)])
    assert run.exit_code == 0, run.output
    for words in ("figures to reach", "isam2", "gtsam 4", "MB at the end", "not measured"):
        assert words in run.stdout
    figures = json.loads(path.read_text())
    assert set(figures) == {"rows", "soaks", "exponents", "criteria", "settings", "environment"}
    assert {"milliseconds", "ratio", "largest_error", "memory"} <= set(figures["rows"][0])
    assert {criterion["reached"] for criterion in figures["criteria"]} <= {True, False, None}
    assert figures["settings"]["seed"] == 0


@pytest.mark.parametrize("sizes", ["10,many", "1", ""])
def test_sizes_that_are_none_are_one_line_of_error(sizes: str) -> None:
    run = CliRunner().invoke(app, ["estimators", "--sizes", sizes])
    assert run.exit_code == 2
    assert "sizes" in run.output


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match="at least 2 nodes"):
        EstimatorBenchSettings(sizes=(1,))
    with pytest.raises(InputError, match="frames"):
        EstimatorBenchSettings(frames=0)


@pytest.mark.parametrize("kind", ["connected", "components"])
def test_flocks_are_what_their_names_say(kind) -> None:
    scene = flock(kind, 20, 3, seed=1)
    again = flock(kind, 20, 3, seed=1)
    for frame, same in zip(scene.frames, again.frames, strict=True):
        np.testing.assert_array_equal(frame.measurements.z, same.measurements.z)
        (edges,) = frame.transition.graph.edges
        assert np.bincount(edges.target, minlength=20).max() <= 4
        assert not (edges.target == edges.source).any()
    first, second = (frame.transition.graph.edges[0] for frame in scene.frames[:2])
    assert first.rate.tolist()[:5] != second.rate.tolist()[:5]


def test_the_windows_of_both_smoothers_hold_the_same_moments() -> None:
    scene = flock("components", 6, 9, seed=2)
    ours, theirs = OurWindow(5, scene), GtsamWindow(5, scene)
    for frame in scene.frames:
        for contender in (ours, theirs):
            contender.prepare(frame)
            contender.step()
        assert len(ours.window) == len(theirs.window)
    np.testing.assert_allclose(np.array(ours.window), theirs.window, atol=1e-8)
    np.testing.assert_allclose(ours.read()[1], theirs.covariances(), atol=1e-9)


def test_the_textbook_is_driven_as_our_filter_is() -> None:
    scene = flock("connected", 7, 4, seed=3)
    ours, textbook = Ours(JointKalmanFilter(), scene), Textbook(scene)
    for frame in scene.frames:
        for contender in (ours, textbook):
            contender.prepare(frame)
            contender.step()
    for mine, theirs in zip(ours.read(), textbook.read(), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-10)


def test_criteria_know_what_was_reached_missed_and_not_measured() -> None:
    rows = [
        Row("filter", "components", 100, "isam2", 1.0, 0.4),
        Row("filter", "connected", 100, "isam2", 9.0, 4.5),
        Row("filter", "components", 300, "kalman", 1.0, 0.1),
        Row("filter", "components", 1000, "kalman", 3.5, math.nan),
    ]
    soak = Soak("isam2", "components", 100, 10, (1.0, 2.0), (100.0, 101.0))
    found = {criterion.name: criterion.reached for criterion in criteria(rows, [soak])}
    assert found["isam2 / textbook, components, 100"] is True
    assert found["isam2 / textbook, connected, 100"] is False
    assert found["kalman, components, 1000 / 300 nodes"] is True
    assert found["batch / textbook, connected"] is None
    assert found["isam2, components, 10 frames: time, old / young"] is False
    assert found["isam2, components, 10 frames: memory, end / start"] is True


def test_the_exponent_is_that_of_a_power_law() -> None:
    rows = [Row("filter", "connected", n, "kalman", 2e-3 * n**2.5, math.nan) for n in (10, 50, 100, 300)]
    rows[0] = Row("filter", "connected", 10, "kalman", 100.0, math.nan)  # too few nodes to count
    assert exponents(rows) == {"kalman, connected": pytest.approx(2.5)}
    assert exponents(rows[:3]) == {}


def test_arrays_are_counted_once() -> None:
    array = np.zeros(1000)
    assert size_of((array, [array, {"again": array}])) == pytest.approx(8e-3)
