"""Beliefs about lights that nobody reports: figures of known beliefs, and the command on a crossing written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.signals import BelievedLight, log_loss, time_to_red
from tests.data_tools.ngsim_example import crossing, rows, write_ngsim


def test_log_loss_is_that_of_what_was_the_case() -> None:
    belief, truth = np.array([0.9, 0.2]), np.array([True, False])
    assert log_loss(belief, truth) == pytest.approx(-(np.log(0.9) + np.log(0.8)) / 2)


def test_red_counts_from_the_first_vehicle_that_is_held() -> None:
    since, green = np.arange(5) * 0.1, np.array([0.5, 0.4, 0.3, 0.1, 0.1])
    held = np.array([False, True, True, True, True])
    red = BelievedLight("A", since, green, np.zeros(5, dtype=bool), held)
    never = BelievedLight("B", since, np.full(5, 0.5), np.zeros(5, dtype=bool), held)
    open_light = BelievedLight("C", since, green, np.ones(5, dtype=bool), held)
    assert time_to_red([red, never, open_light]) == pytest.approx([0.2, np.inf])


def test_the_command(tmp_path: Path) -> None:
    root = write_ngsim(tmp_path, rows(), {"A": crossing()})
    result = CliRunner().invoke(app, ["signals", "--dataroot", str(root)])
    assert result.exit_code == 0, result.output
    assert "Reliability" in result.output
    wrong = CliRunner().invoke(app, ["signals", "--dataroot", str(root), "--scenes", "B"])
    assert wrong.exit_code != 0
