"""The Intelligent Driver Model as an interaction: its law, its derivatives, and what drivers do not do."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from saga_fg import InputError
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Following
from saga_fg.model.graph_building import build_graph
from saga_fg.model.nonlinear_interactions import HIDDEN_VEHICLE_GAP, MAX_DECELERATION, STOP_TIME, IntelligentDriver
from saga_fg.model.stability import require_stable
from saga_fg.model.stop_lines import DriverStopping, RedLight
from tests.saga_fg.road_scenes import queue, table

DRIVER = IntelligentDriver(free_speed=14.0, headway=1.2, acceleration=1.5, deceleration=2.0)
speeds, gaps = st.floats(0, 16), st.floats(0.6, 80)


def value(function, *arguments):
    return float(function(*(np.array([float(x)]) for x in arguments)).value[0])


def derivatives(found):
    return np.array([float(part[0]) for part in found[1:]])


@given(v=speeds, s=gaps, w=speeds)
def test_derivatives_are_those_of_the_law(v, s, w):
    found = DRIVER.following(*(np.array([x]) for x in (v, s, w)))
    eps = 1e-6
    steps = np.eye(3) * eps
    low, high = ([value(DRIVER.following, *(np.array([v, s, w]) + sign * e)) for e in steps] for sign in (-1, 1))
    centre = np.full(3, value(DRIVER.following, v, s, w))
    one_sided = np.stack([centre - low, high - centre]) / eps
    assume(np.allclose(*one_sided, atol=1e-3))  # not at a corner of the law
    assert np.allclose(derivatives(found), one_sided.mean(axis=0), atol=2e-3)


@given(v=st.floats(0.5, 13.5))
def test_in_equilibrium_nobody_accelerates(v):
    gap = (DRIVER.standstill_gap + v * DRIVER.headway) / math.sqrt(1 - (v / DRIVER.free_speed) ** 4)
    assert value(DRIVER.alone, v, gap, v) == pytest.approx(0, abs=1e-9)
    assert value(DRIVER.alone, v, gap - 0.5, v) < 0 < value(DRIVER.alone, v, gap + 0.5, v)


@given(v=speeds, s=gaps, w=speeds)
def test_drivers_brake_within_limits_and_never_backwards(v, s, w):
    braking = -value(DRIVER.alone, v, s, w)
    assert braking <= MAX_DECELERATION + 1e-9
    assert braking <= v / STOP_TIME + 1e-9


def test_who_stands_behind_one_who_stands_stays():
    for gap in (2.5, 5.0, 30.0):
        assert value(DRIVER.following, 0, gap, 0) == 0
        assert value(DRIVER.stopping, 0, gap) == 0
    assert value(DRIVER.following, 0, 5.0, 2.0) > 0.5


@given(v=speeds, w=speeds, s=st.floats(7, 80))
def test_nobody_speeds_up_into_a_gap_with_room_for_another(v, w, s):
    assert value(DRIVER.following, v, s, w) <= w - v + 1e-9
    assert value(DRIVER.stopping, v, s) <= 0
    close = HIDDEN_VEHICLE_GAP - 0.1
    assert value(DRIVER.following, v, close, w) == value(DRIVER.alone, v, close, w)


def test_a_queue_comes_to_a_halt_before_the_line():
    """Step by step along the graph, as in a prediction: all stand at last, in order, none beyond the line."""
    rules = [
        RedLight(interaction=DriverStopping(driver=DRIVER), reaction_deceleration=0.0, full_deceleration=1e-3),
        Following(interaction=DRIVER, gap_scale=math.inf, max_gap=80.0, parked=True),
    ]
    nodes = queue()
    state = np.concatenate([np.concatenate([nodes.position, nodes.velocity], axis=1)[:4].ravel(), nodes.position[4]])
    for _ in range(120):
        moving = state[:16].reshape(4, 4)
        rows = [("car", *x[:2], x[2], 0.0, 4) for x in moving] + [("stop_line", 0, 1.75, 0, 0, 0)]
        now = table(rows, np.array([0, 0, 0, 0, 1.0]), nodes.outline)
        step = discretise(build_graph(now, rules), 0.25)
        state = step.F_matrix @ state + step.b
    x, v = state[:16].reshape(4, 4)[:, 0], state[:16].reshape(4, 4)[:, 2]
    assert np.all(np.abs(v) < 0.1)
    assert -6 < x[0] + 2 < -1
    assert np.all((x[:2] - x[1:3] - 4 > 1) & (x[:2] - x[1:3] - 4 < 5))
    assert -6 < x[3] + 2 < -1


def test_a_vehicle_tracked_twice_does_not_lead_itself():
    rows = [("car", 0, 0, 8, 0, 5), ("car", 2, 0, 8, 0, 5), ("car", 20, 0, 8, 0, 5)]
    led = Following(interaction=DRIVER, min_separation=0.8).pairs(table(rows))
    assert dict(zip(led.target.tolist(), led.source.tolist(), strict=True)) == {0: 2, 1: 2}


def test_the_law_is_stable():
    require_stable([Following(interaction=DRIVER, rate=1.0)])


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="headway"):
        IntelligentDriver(headway=0.0)


def test_a_trailer_leads_and_is_not_led():
    """Its gap to its truck is none that a driver keeps."""
    rows = [("truck", 0, 0, 8, 0, 8), ("trailer", -8.5, 0, 8, 0, 7), ("car", -25, 0, 8, 0, 5)]
    led = Following(interaction=DRIVER, towed=("trailer",)).pairs(table(rows))
    assert dict(zip(led.target.tolist(), led.source.tolist(), strict=True)) == {2: 1}
