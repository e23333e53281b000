"""The benchmark of wrong clocks: its tables, and what falls short."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.runner import tables
from benchmarks.service.clocks import ClockFault, SteadyOffset, WrongClock, clock_rows, clock_shortcomings, wrong_clock

AHEAD, GLITCH = ClockFault("steady", 1.0), ClockFault("glitch", 8.0, 2)
WRONG = [
    WrongClock("radar", 5.0, AHEAD, {"lidar": 1.0, "camera": 0.995}),
    WrongClock("lidar", 5.0, AHEAD, {"camera": 1.0, "radar": 1.0}),
    WrongClock("radar", 5.0, GLITCH, {"lidar": 1.0, "camera": 1.0}),
]
STEADY = SteadyOffset("lidar", 0.5, np.array([0.003, -0.004]), 1.0, (0.102, 0.1))


def test_a_row_for_each_fault_and_each_offset() -> None:
    tracked, offsets = tables(list(clock_rows(WRONG, [STEADY])))
    assert tracked.columns == ("fault of the clock", "of the radar, radar at 5 Hz", "of the lidar, radar at 5 Hz")
    assert tracked.rows == (("+1 s", "99.5", "100"), ("+8 s, 2 frames", "100", ""))
    assert offsets.rows == (("lidar, +-0.5 s", "4", "3.536", "100", "0.102", "1.02"),)


def test_what_falls_short_is_named() -> None:
    assert clock_shortcomings(WRONG, [STEADY]) == []
    few = replace(WRONG[0], tracked={"lidar": 0.5, "camera": 1.0})
    poor = replace(STEADY, errors=np.array([0.02, np.nan]), within=0.5, rmse=(0.2, 0.1))
    found = clock_shortcomings([few], [poor])
    assert [text.split(",")[0] for text in found] == [
        *("radar +1 s", "lidar 0.5 s: estimate off by nan ms"),
        *("lidar 0.5 s: error of positions 2.000 times that without an offset",),
        *("50 % of estimates within two deviations",),
    ]


@pytest.mark.parametrize("fault", [ClockFault("steady", 3600.0), ClockFault("jumps")], ids=str)
def test_right_sensors_are_tracked_beside_a_wrong_one(fault: ClockFault) -> None:
    found = wrong_clock(3, "radar", 5.0, fault, seed=0)
    assert set(found.tracked) == {"lidar", "camera"}
    assert min(found.tracked.values()) >= 0.99
