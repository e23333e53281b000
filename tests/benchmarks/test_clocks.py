"""The benchmark of wrong clocks: its figures, and what falls short."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.service import clocks
from benchmarks.service.clocks import ClockFault, fault_rows, offset_figures, offset_shortcomings, wrong_clock
from saga_fg.errors import SagaError

SIGMA = np.full(2, 0.002)


def test_a_row_for_each_fault_and_a_word_for_what_falls_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clocks, "FAULTS", (ClockFault("steady", 1.0), ClockFault("glitch", 8.0, 2)))
    monkeypatch.setattr(clocks, "RADAR_RATES", (5.0,))
    monkeypatch.setattr(clocks, "wrong_clock", lambda _, wrong, rate, fault, seed: 0.5 if wrong == "radar" else 1.0)
    found = fault_rows(0)
    assert [figures for _, figures in (next(found), next(found))] == [
        {"fault of the clock": name, "of the radar, radar at 5 Hz": 50.0, "of the lidar, radar at 5 Hz": 100.0}
        for name in ("+1 s", "+8 s, 2 frames")
    ]
    with pytest.raises(SagaError, match=r"\+1 s, of the radar, radar at 5 Hz: 50.0 % tracked; \+8 s, 2 frames"):
        next(found)


def test_offsets_are_judged_by_estimate_and_positions() -> None:
    good = offset_figures(np.array([0.003, -0.004]), SIGMA, np.full(2, 0.102), 0.1)
    assert good == pytest.approx(
        {
            "largest error, ms": 4.0,
            "rms error, ms": 3.5355339,
            "within two deviations, %": 100.0,
            "error of positions, m": 0.102,
            "by that without an offset": 1.02,
        }
    )
    assert offset_shortcomings(good) == []
    poor = offset_figures(np.array([0.02, np.nan]), SIGMA, np.full(2, 0.2), 0.1)
    assert poor["within two deviations, %"] == 0.0
    assert [text.split(",")[0] for text in offset_shortcomings(poor)] == [
        "estimate off by nan ms",
        "error of positions 2.000 times that without an offset",
    ]


@pytest.mark.parametrize("fault", [ClockFault("steady", 3600.0), ClockFault("jumps")], ids=str)
def test_right_sensors_are_tracked_beside_a_wrong_one(fault: ClockFault) -> None:
    assert wrong_clock(3, "radar", 5.0, fault, seed=0) >= 0.99
