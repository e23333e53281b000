"""The synthetic benchmark in miniature: scenes are what they say, cells are compared, the command writes figures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import synthetic as bench
from benchmarks.app import app
from benchmarks.sampled_scenes import INTERVAL, SceneSettings, sample_scene
from data_tools.datasets.source import names
from saga_fg.model.edge_rules import Neighbours

SHORT = SceneSettings(groups=2, members=3, seconds=6.0)


def speeds_apart(coupling: float) -> float:
    """Spread of the velocities of a group, m/s, at the end of a scene."""
    scene = sample_scene(replace(SHORT, coupling=coupling, seconds=12.0), 0)
    assert scene.ground_truth is not None
    velocity = scene.ground_truth[-1].boxes.velocity.reshape(2, 3, 2)
    return float((velocity - velocity.mean(axis=1, keepdims=True)).std())


def test_coupled_groups_stay_together() -> None:
    assert speeds_apart(4.0) < 0.5 * speeds_apart(0.0)


def test_hidden_objects_are_not_detected_and_as_many_are_hidden_as_asked_for() -> None:
    settings = SceneSettings(hidden=0.4, clutter=0.0, detected=1.0, seconds=60.0)
    scene = sample_scene(settings, 1)
    assert scene.ground_truth is not None
    visible = np.array([truth.visible for truth in scene.ground_truth])
    assert [len(frame) for frame in scene.frames] == visible.sum(axis=1).tolist()
    assert 0.2 < 1 - visible.mean() < 0.45  # windows overlap
    assert np.diff(scene.timestamps) == pytest.approx(INTERVAL)


def test_a_scene_is_its_seed() -> None:
    first, second, other = (sample_scene(SHORT, seed) for seed in (3, 3, 4))
    positions = [scene.frames[-1].detections.boxes.position.tolist() for scene in (first, second, other)]
    assert positions[0] == positions[1] != positions[2]


@pytest.fixture
def little_to_learn_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "FIT_SCENES", 1)
    monkeypatch.setattr(bench, "LEARNED_SECONDS", 0.6)


@pytest.fixture
def uncoupled(little_to_learn_from: None) -> tuple[bench.Cell, ...]:
    return bench.bench_synthetic(range(2), {"no coupling": replace(SHORT, coupling=0.0)})


def test_without_coupling_the_true_interactions_change_nothing(uncoupled: tuple[bench.Cell, ...]) -> None:
    """But for the process noise, which kf has from another scene."""
    (cell,) = uncoupled  # and no pool of cells with interactions
    assert cell.figure(bench.SAGA, "MOTP") == pytest.approx(cell.figure(bench.KF, "MOTP"), rel=0.05)
    assert cell.figure(bench.GRAPH, "MOTA") == cell.figure(bench.SAGA, "MOTA")


def test_a_cell_says_what_is_worse_in_it(uncoupled: tuple[bench.Cell, ...]) -> None:
    metrics = uncoupled[0].metrics[bench.KF]
    confused = [replace(scene, switches=scene.switches + 3) for scene in metrics]
    cell = bench.Cell("two", {bench.KF: metrics, bench.SAGA: metrics, bench.GRAPH: confused})
    assert cell.worse(bench.SAGA, bench.KF) == ()
    assert "MOTA" in cell.worse(bench.GRAPH, bench.KF)
    assert "MOTP" not in cell.worse(bench.GRAPH, bench.KF)
    assert cell.figure(bench.GRAPH, "IDS") == cell.figure(bench.KF, "IDS") + 3


@pytest.mark.usefixtures("little_to_learn_from")
def test_the_command_writes_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "CELLS", {"base": SHORT})
    figures = tmp_path / "figures.json"
    result = CliRunner().invoke(app, ["synthetic", "--seeds", "2", "--json", str(figures)])
    assert result.exit_code == 0, result.output
    read = json.loads(figures.read_text())
    assert set(read) == {"base", "all interacting"}
    assert set(read["base"]["figures"]) == set(bench.CONTENDERS)
    refused = CliRunner().invoke(app, ["synthetic", "--cells", "nothing"])
    assert refused.exit_code != 0
    assert "expected some of base" in refused.output


def test_every_cell_can_be_asked_for_and_no_pool_has_the_name_of_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    assert names("--cells", ",".join(bench.CELLS)) == tuple(bench.CELLS)
    monkeypatch.setattr(
        bench, "_cell", lambda name, settings, seeds: bench.Cell(name, {c: [] for c in bench.CONTENDERS})
    )
    shown = [part.name for part in bench.bench_synthetic(range(2))]
    assert len(set(shown)) == len(bench.CELLS) + 2


def test_learned_interactions_are_from_scenes_of_other_seeds_and_near_the_true_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = SceneSettings(groups=3, members=5, seconds=5.0)
    monkeypatch.setattr(bench, "LEARNED_SCENES", 1)
    config = bench.CONTENDERS[bench.LEARNED](settings, [sample_scene(settings, 5)])
    (rule,) = config.tracker.edges
    assert isinstance(rule, Neighbours)
    near = rule.rate * np.exp(-((settings.spacing / rule.distance_scale) ** 2) / 2)  # at the spacing of a group
    assert near == pytest.approx(settings.rule.rate, rel=0.4)
