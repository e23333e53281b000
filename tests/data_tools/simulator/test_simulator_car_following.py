"""The Intelligent Driver Model: its equilibrium, and what a queue of such drivers does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.simulator.fleet import (
    CAR,
    HARDEST_BRAKING,
    KINDS,
    Drivers,
    Fleet,
    equilibrium_gap,
    following_acceleration,
    free_acceleration,
)
from data_tools.simulator.road import Lanes, curved_road
from data_tools.simulator.scene_layout import ClosingLine, SceneLayout, SlowZone, sample_intervals
from data_tools.simulator.traffic import Traffic, record_traffic
from saga_fg.numerics.arrays import FloatArray


def drivers(count: int, desired_speed: float = 14.0) -> Drivers:
    return Drivers(*(np.full(count, value) for value in (desired_speed, 1.2, 2.0, 1.5, 2.0)))


def fleet(count: int, leader_desires: float) -> Fleet:
    size = np.tile(KINDS[CAR].size, (count, 1))
    behind = drivers(count)
    desired_speed = np.where(np.arange(count) == 0, leader_desires, behind.desired_speed)
    return Fleet(np.full(count, CAR), size, replace(behind, desired_speed=desired_speed))


def queue(
    count: int,
    speed: float,
    stop_lines: tuple[ClosingLine, ...] = (),
    slow_zones: tuple[SlowZone, ...] = (),
    length: float = 2000.0,
    leader_desires: float = 14.0,
    noise: float = 0.0,
    reaction: float = 0.0,
) -> Traffic:
    """`count` cars one behind the other in equilibrium at `speed`, the first, row 0, at 1000 m."""
    road = curved_road(length, [], np.zeros(2), 0.0)
    lanes = Lanes(road, np.array([-1.75]), np.array([1]))
    cars = fleet(count, leader_desires)
    spacing = float(equilibrium_gap(speed, drivers(1))[0]) + KINDS[CAR].size[0]
    s = 1000.0 - spacing * np.arange(count)
    lane, trailer = np.zeros(count, dtype=np.int64), np.zeros(count)
    layout = SceneLayout(
        lanes, 0.0, None, cars, lane, s, np.full(count, speed), tuple(stop_lines), tuple(slow_zones), trailer
    )
    return Traffic(layout, np.random.default_rng(0), noise=noise, reaction=reaction)


@given(speed=st.floats(0.0, 13.5), lead=st.floats(-3.0, 3.0))
def test_acceleration_vanishes_at_the_equilibrium_gap_alone(speed: float, lead: float) -> None:
    driver, v = drivers(1), np.array([speed])
    gap = equilibrium_gap(speed, driver)
    assert gap == pytest.approx((2.0 + 1.2 * speed) / np.sqrt(1 - (speed / 14.0) ** 4))
    total = free_acceleration(v, driver) + following_acceleration(v, gap, v, driver)
    assert total[0] == pytest.approx(0.0, abs=1e-9)
    wider = free_acceleration(v, driver) + following_acceleration(v, gap + abs(lead) + 0.1, v, driver)
    assert wider[0] > 0


def test_acceleration_is_within_what_engine_and_brakes_can_do() -> None:
    rng = np.random.default_rng(0)
    n = 1000
    v, gap, leader = rng.uniform(0, 30, n), rng.uniform(0, 50, n), rng.uniform(0, 30, n)
    pull = following_acceleration(v, gap, leader, drivers(n))
    assert (pull <= 0).all()
    assert (pull >= -HARDEST_BRAKING).all()
    free = free_acceleration(v, drivers(n), 5.0)
    assert (free <= 1.5).all()
    assert (free >= -2.0).all()


def test_followers_settle_at_the_equilibrium_gap_of_a_steady_leader() -> None:
    traffic = queue(6, 5.0, length=4000.0, leader_desires=8.0)
    for _ in range(4000):
        traffic.step()
    assert traffic.speed == pytest.approx(np.full(6, 8.0), abs=0.01)
    gap = traffic.s[:-1] - traffic.s[1:] - KINDS[CAR].size[0]
    assert gap == pytest.approx(equilibrium_gap(8.0, drivers(5)), rel=0.01)


def test_a_slow_down_runs_backwards_through_the_queue_as_a_wave() -> None:
    zone = SlowZone(np.array([0]), 1010.0, 1100.0, 2.0, np.array([[0.0, 8.0]]))
    history = record_traffic(queue(12, 10.0, slow_zones=(zone,)), 600)
    lowest = history.speed.argmin(axis=0)
    when, where = history.time[lowest], history.s[lowest, np.arange(12)]
    in_wave = slice(2, 10)  # the first two meet the slow zone itself
    assert (history.speed.min(axis=0)[in_wave] < 6.0).all()  # everybody brakes,
    assert (np.diff(when[in_wave]) > 0.2).all()  # one after the other,
    assert (np.diff(where[in_wave]) < 0).all()  # and further back
    wave_speed = np.polyfit(when[in_wave], where[in_wave], 1)[0]
    assert -9.0 < wave_speed < -2.0  # m/s; in real traffic about -4


def test_a_red_light_stops_the_queue_before_the_line_and_green_lets_it_go() -> None:
    line = ClosingLine(np.array([0]), 1100.0, np.array([[0.0, 40.0]]))
    history = record_traffic(queue(8, 10.0, stop_lines=(line,)), 1600)
    half = KINDS[CAR].size[0] / 2
    red = history.time < 40.0
    assert (history.s[red] + half < 1100.0).all()
    just_before = int(np.flatnonzero(red)[-1])
    assert history.speed[just_before].max() < 0.2
    assert (history.s[-1, :4] > 1100.0).all()


def test_who_cannot_stop_any_more_passes_the_light() -> None:
    line = ClosingLine(np.array([0]), 1012.0, np.array([[0.0, 40.0]]))
    history = record_traffic(queue(3, 12.0, stop_lines=(line,)), 600)
    assert history.s[-1, 0] > 1100.0  # was 10 m before the line
    assert history.s[-1, 1] < 1012.0
    assert np.diff(history.speed, axis=0).min() / 0.05 > -6.0


@pytest.mark.parametrize("seed", range(3))
def test_reaction_time_and_noise_cause_no_collision(seed: int) -> None:
    rng = np.random.default_rng(seed)
    active = sample_intervals((4.0, 8.0), (4.0, 8.0), 60.0, rng)
    zone = SlowZone(np.array([0]), 900.0, 1500.0, 1.0, active)
    history = record_traffic(queue(15, 11.0, slow_zones=(zone,), noise=0.4, reaction=0.4), 1200)
    gap = history.s[:, :-1] - history.s[:, 1:] - KINDS[CAR].size[0]
    assert gap.min() > 0.3
    assert history.speed.min() >= 0.0


def test_intervals_alternate_and_cover_the_time() -> None:
    for seed in range(20):
        intervals: FloatArray = sample_intervals((3.0, 5.0), (2.0, 4.0), 50.0, np.random.default_rng(seed))
        on, off = intervals[:, 1] - intervals[:, 0], intervals[1:, 0] - intervals[:-1, 1]
        assert ((on >= 3) & (on <= 5)).all()
        assert ((off >= 2) & (off <= 4)).all()
        assert intervals[0, 0] <= 0
        assert intervals[-1, 1] + 4 >= 50
