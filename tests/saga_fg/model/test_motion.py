"""Node types: named components, and own motions that are what the books say."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg

from saga_fg import ConstantAcceleration, ConstantVelocity, InputError, NodeType, RandomWalk


@dataclass(frozen=True)
class Custom:
    """A motion made of whatever the test wants."""

    components: tuple
    generator: object
    diffusion: object


def test_constant_velocity_moves_in_a_straight_line():
    car = NodeType("car", ConstantVelocity())
    assert car.components == ("x", "y", "vx", "vy")
    assert car.dim == 4
    moved = scipy.linalg.expm(car.generator * 2.0) @ [1.0, 2.0, 3.0, -1.0]
    assert moved == pytest.approx([7.0, 0.0, 3.0, -1.0])
    assert np.diag(NodeType("car", ConstantVelocity(2.5)).diffusion).tolist() == [0, 0, 2.5, 2.5]


def test_constant_acceleration_moves_on_a_parabola():
    car = NodeType("car", ConstantAcceleration(jerk_noise=0.3))
    moved = scipy.linalg.expm(car.generator * 2.0) @ [0.0, 0.0, 1.0, 0.0, 0.5, -1.0]
    assert moved == pytest.approx([3.0, -2.0, 2.0, -2.0, 0.5, -1.0])
    assert np.diag(car.diffusion).tolist() == [0, 0, 0, 0, 0.3, 0.3]


def test_a_fading_acceleration_falls_by_e_in_its_time_constant():
    car = NodeType("car", ConstantAcceleration(fading_time=0.5))
    moved = scipy.linalg.expm(car.generator * 0.5) @ [0, 0, 0, 0, 1.0, 2.0]
    assert moved[4:] == pytest.approx([np.exp(-1), 2 * np.exp(-1)])
    assert moved[2:4] == pytest.approx([0.5 * (1 - np.exp(-1)), 1.0 * (1 - np.exp(-1))])


def test_a_random_walk_stands_still_without_drift():
    pole = NodeType("pole", RandomWalk())
    assert pole.dim == 2
    assert not pole.generator.any()
    assert not pole.diffusion.any()
    assert NodeType("cone", RandomWalk(drift=0.2)).diffusion.tolist() == (0.2 * np.eye(2)).tolist()


def test_components_are_found_by_name():
    car = NodeType("car", ConstantAcceleration())
    assert car.index(("vy", "x")).tolist() == [3, 0]
    assert car.has(("x", "ax"))
    assert not car.has(("x", "z"))
    assert car.selector(("vx", "vy")) @ np.arange(6) == pytest.approx([2, 3])
    assert car.selector(()).shape == (0, 6)
    with pytest.raises(InputError, match="node type car has no component 'z'; it has x, y, vx, vy, ax, ay"):
        car.index(("x", "z"))


def test_a_motion_that_makes_no_sense_is_refused(subtests):
    for motion, message in [
        (Custom((), np.empty((0, 0)), np.empty((0, 0))), "node type odd: expected distinct component names"),
        (Custom(("x", "x"), np.eye(2), np.eye(2)), "node type odd: expected distinct component names"),
        (Custom(("x",), np.eye(2), np.eye(1)), r"node type odd: generator: expected shape \(1, 1\), got \(2, 2\)"),
        (Custom(("x",), [[np.nan]], np.eye(1)), r"node type odd: generator\[0, 0\]: expected a finite number"),
        (Custom(("x",), np.eye(1), np.eye(2)), r"node type odd: diffusion: expected shape \(1, 1\)"),
        (Custom(("x", "y"), np.eye(2), [[1, 0.5], [0, 1]]), "node type odd: diffusion: expected a symmetric positive"),
        (Custom(("x", "y"), np.eye(2), [[1, 2], [2, 1]]), "node type odd: diffusion: expected a symmetric positive"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            NodeType("odd", motion)
