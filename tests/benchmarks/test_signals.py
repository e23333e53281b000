"""Beliefs about lights that nobody reports: figures of known beliefs, and the command on a crossing written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.signals import BelievedLight, left_out, log_loss, time_to_red
from saga_fg import InputError
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


def test_what_is_chosen_for_a_window_is_best_on_the_others() -> None:
    def light(window: str, green: float) -> BelievedLight:
        ones = np.ones(3, dtype=bool)
        return BelievedLight(window, np.arange(3.0), np.full(3, green), ones, ones)

    first = [light("A", 0.9), light("B", 0.2), light("C", 0.6)]
    second = [light("A", 0.2), light("B", 0.9), light("C", 0.7)]
    assert left_out([first, second], {"A": "A", "B": "B", "C": "B"}) == [1, 0]
    with pytest.raises(InputError, match="--left-out: expected windows that do not overlap"):
        left_out([first, second], {"A": "A", "B": "A", "C": "A"})


def test_the_command(tmp_path: Path) -> None:
    root = write_ngsim(tmp_path, rows(), {"A": crossing()})
    result = CliRunner().invoke(app, ["signals", "--dataroot", str(root)])
    assert result.exit_code == 0, result.output
    assert "Reliability" in result.output
    wrong = CliRunner().invoke(app, ["signals", "--dataroot", str(root), "--scenes", "B"])
    assert wrong.exit_code != 0
