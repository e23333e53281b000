"""The benchmark of hidden objects: what it counts, and that its command runs from end to end."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.occlusion import until_last_seen
from pipelines.config import load_config
from saga_fg import Annotations, Boxes


def moment(**visible: bool) -> Annotations:
    """Objects by name, with whether they are visible."""
    boxes = Boxes.of(["car"] * len(visible), [[10.0 * k, 0.0, 1.0] for k in range(len(visible))])
    return Annotations(np.array(list(visible)), boxes, np.array(list(visible.values())))


def test_an_object_that_is_never_seen_again_has_left() -> None:
    moments = [moment(a=True, b=True), moment(a=False, b=False), moment(a=True, b=False), moment(b=False)]
    kept = until_last_seen(moments)
    assert [truth.id.tolist() for truth in kept] == [["a", "b"], ["a"], ["a"], []]
    assert [truth.visible.tolist() for truth in kept] == [[True, True], [False], [True], []]


def test_fitted_noise_reaches_the_classes_and_nothing_else() -> None:
    config = load_config("simulated")
    fitted = config.with_acceleration_noise({"default": 0.5, "truck": 0.25})
    classes = fitted.tracker.classes
    assert classes["truck"].motion.acceleration_noise == 0.25
    assert classes["default"].motion.acceleration_noise == 0.5
    assert classes["pedestrian"] == config.tracker.classes["pedestrian"]
    assert classes["truck"].max_distance == classes["default"].max_distance
    assert fitted.tracker.edges == config.tracker.edges


def test_the_command_prints_both_methods_and_writes_its_figures(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    arguments = ["occlusion", "--scenes", "2", "--fit-scenes", "1", "--json", str(file)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "saga / kf - 1" in result.output
    figures = json.loads(file.read_text())
    kf, saga = figures["hidden_rmse"]["kf"], figures["hidden_rmse"]["saga"]
    assert figures["hidden_change"]["estimate"] == pytest.approx(saga / kf - 1)
    assert figures["hidden_change"]["low"] <= figures["hidden_change"]["estimate"] <= figures["hidden_change"]["high"]


def test_it_refuses_to_fit_where_it_compares() -> None:
    result = CliRunner().invoke(app, ["occlusion", "--seed", "3", "--fit-seed", "4", "--scenes", "2"])
    assert result.exit_code == 2
    assert "--fit-seed 4" in result.output
