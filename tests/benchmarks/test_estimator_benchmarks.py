"""Benchmarks of estimators."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks import smoothing
from benchmarks.agreement import pairwise_agreement
from benchmarks.app import app
from benchmarks.estimators import estimators
from benchmarks.modes import FRAMES, draw, enumerated, matched
from benchmarks.sampled_traffic import providers
from benchmarks.settling import EVADING, MIXED, SILENT, STRAIGHT, largest_difference, sample_scene
from benchmarks.smoothing import smooth_known_objects, true_objects
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.smoothing import load_smooth_config
from saga_fg.estimators import BatchSolver, IncrementalSmoother
from saga_fg.smoothing import gather_evidence


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    return [{"table": title, **row} for title, row in estimators("4,8", 2, 30.0, 4, 6)]


def test_every_exact_estimator_is_exact(rows):
    ours = [row for row in rows if row.get("estimator") in ("kalman", "isam2", "fixed-lag", "batch") and "case" in row]
    assert {(row["case"], row["estimator"]) for row in ours} == {
        *(("filter", "kalman"), ("filter", "isam2"), ("fixed lag", "fixed-lag"), ("batch", "batch"))
    }
    for row in ours:
        assert row["mean"] <= row["largest"] < 1e-8
        assert row.get("covariance", 0.0) < 1e-9


def test_ratios_are_those_of_the_times(rows):
    baselines = {"filter": "textbook", "batch": "textbook", "fixed lag": "GTSAM's", "running graph": "linear"}
    cases = [row for row in rows if "case" in row]
    for row in cases:
        same = [r for r in cases if all(r[key] == row[key] for key in ("case", "graph", "nodes"))]
        (base,) = [r for r in same if r["estimator"] == baselines[row["case"]]]
        assert row["ratio"] == pytest.approx(row["ms"] / base["ms"])
    drivers = {row["graph"] for row in cases if row["estimator"] == "intelligent driver"}
    assert drivers == {"connected", "components"}


def test_sizes_that_are_none_are_one_line_of_error(refused):
    for sizes in ("10,many", "1", ""):
        assert "--sizes: expected whole numbers >= 2" in refused("estimators --sizes", sizes)


# The incremental smoother beside Levenberg-Marquardt on nonlinear scenes


def test_the_smoother_is_compared_with_the_minimum_of_the_same_graph():
    scene = sample_scene(EVADING, np.random.default_rng(4), frames=8)
    smoother, batch = IncrementalSmoother(providers(scene), None), BatchSolver(providers(scene))
    for frame in scene.frames:
        smoother.step(frame.time)
        batch.step(frame.time)
    assert smoother.graph().variables.keys() == batch.graph().variables.keys()
    assert largest_difference(smoother, batch) < SILENT
    smoother.step(99.0, [])
    assert largest_difference(smoother, batch) < SILENT


def test_the_command_prints_a_row_for_every_kind(tmp_path):
    figures = tmp_path / "figures.json"
    result = CliRunner().invoke(app, f"settling --mixed 1 --crossings 2 --frames 8 --json {figures}".split())
    assert result.exit_code == 0, result.output
    rows = json.loads(figures.read_text())["rows"]
    assert [row["scenes"] for row in rows] == [MIXED, EVADING, STRAIGHT]
    assert all(row["frames"] == 8 and 0 <= row["settled, %"] <= 100 for row in rows)


# Moments matched node by node, beside every sequence of modes


def test_both_are_exact_where_one_node_has_been_measured_once():
    frames = draw(np.random.default_rng(1), 1)
    exact, own = enumerated(frames), matched(frames)
    np.testing.assert_allclose(own[0].mean, exact[0].mean, atol=1e-9)
    np.testing.assert_allclose(own[0].sigma, exact[0].sigma, rtol=1e-9)
    np.testing.assert_allclose(own[0].stands, exact[0].stands, atol=1e-9)
    assert np.abs(own[-1].mean - exact[-1].mean).max() > 1e-6


def test_the_command_prints_a_row_for_every_number_of_nodes(tmp_path):
    figures = tmp_path / "figures.json"
    result = CliRunner().invoke(app, f"modes --scenes 2 --json {figures}".split())
    assert result.exit_code == 0, result.output
    rows = json.loads(figures.read_text())["rows"]
    assert [(row["nodes"], row["frames"]) for row in rows] == list(FRAMES.items())
    assert all(0 < row["means, sigma"] < 1 and row["sequences"] <= 4096 for row in rows)
    assert [row["matched / enumerated"] for row in rows] == pytest.approx([1, 1, 1], abs=0.2)


# The benchmark of the smoother on hidden objects: detections are given to their true objects


def test_detections_find_their_true_objects():
    scene = SimulatedTraffic(replace(SimulatorSettings(), duration=3.0), scenes=1, seed=4).scene("scene-0001")
    config = load_smooth_config("simulated")
    evidence = gather_evidence(scene.frames, scene.timestamps, config.sensors, config.tracking.tracker.classes)
    assert scene.ground_truth is not None
    names = sorted({str(name) for truth in scene.ground_truth for name in truth.id.tolist()})
    object_of = true_objects(scene, evidence, names)
    assert (object_of >= 0).mean() > 0.7  # the rest is clutter
    states = smooth_known_objects(evidence, object_of, config.smoothing, config.tracking.of_method("kf").tracker)
    assert set(np.unique(states.id).tolist()) == set(np.unique(object_of[object_of >= 0]).tolist())
    last = scene.ground_truth[-1]
    k = int(np.searchsorted(evidence.times, scene.timestamps[-1]))
    ids = np.array([names.index(str(name)) for name in last.id[last.visible].tolist()])
    at = states.rows_of(np.full(len(ids), k), ids)
    error = states.mean[at, :2] + evidence.origin - last.boxes.position[last.visible, :2]
    assert np.median(np.hypot(*error[at >= 0].T)) < 0.15


def test_the_benchmark_compares_the_same_boxes(bench, monkeypatch):
    short = replace(SimulatorSettings(), duration=4.0)
    monkeypatch.setattr(smoothing, "SimulatedTraffic", lambda scenes, seed: SimulatedTraffic(short, scenes, seed))
    (row,) = bench("smoothing --scenes 2")
    assert row["boxes"] > 10
    assert row["relative change"]["estimate"] == pytest.approx(row["with edges"] / row["without"] - 1)


# Pairwise agreement of two groupings

GROUPS = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=20)


def test_an_example_by_hand():
    found = pairwise_agreement([1, 1, 1, 2, 2], [7, 7, 8, 8, 8])
    assert found.precision == pytest.approx(2 / 4)
    assert found.recall == pytest.approx(2 / 4)
    assert pairwise_agreement([1, 2, 3], [1, 1, 1]).recall == 0
    assert pairwise_agreement([], []).f1 == 1


@given(GROUPS)
def test_it_counts_pairs(groups):
    a, b = (np.array([group[side] for group in groups], dtype=np.int64) for side in (0, 1))
    upper = np.triu_indices(len(a), 1)
    one, other = (a[:, None] == a)[upper], (b[:, None] == b)[upper]
    found = pairwise_agreement(a, b)
    assert found.precision == pytest.approx((one & other).sum() / one.sum() if one.any() else 1)
    assert found.recall == pytest.approx((one & other).sum() / other.sum() if other.any() else 1)
    assert pairwise_agreement(a, a + 100).f1 == 1
