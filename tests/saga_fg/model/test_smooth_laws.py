"""Laws of interaction are smooth, and platoons stable."""

import dataclasses
import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import factors
import saga_fg.model
from factors import FactorError, Radar, Range, RangeBearing, RangeRate, Vector, relative_factors
from factors.manifolds import central_differences, wrap_angles
from factors.measurement import soft_distance
from pipelines.config import TrackConfig
from pipelines.configuration import read_settings, write_settings
from saga_fg import InputError
from saga_fg.learning import TEMPLATE
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.graph_building import LearnedInteractions, build_graph, highest_rate, require_stable
from saga_fg.model.interactions import CarFollowing, NodeTable, SharedVelocity, velocity_triples
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.nonlinear_interactions import SmoothDriver, SocialForce
from saga_fg.tracking import TrackerSettings

DISTANCES = np.array([0.0, 1e-9, 1e-8, 1e-7, 1e-6, 1e-3, 0.1, 0.3, 1.0, 5.0])  # m
LIPSCHITZ = 1e5  # of gradients, per m or m/s: drivers at 20 m/s who pass through others need half of it
INTERVALS = 100  # of a path
HALVINGS = 36


@dataclass(frozen=True)
class Smooth:
    """value: (n, D) -> (n, m); gradient: (n, D) -> (n, m, D); paths (k, 2, D): straight, from one end to the other.

    angles: components of the value that are angles; bound: of the change of the gradient along a path, a unit of it
    model: a measurement model
    """

    value: Callable[[np.ndarray], np.ndarray]
    gradient: Callable[[np.ndarray], np.ndarray]
    paths: np.ndarray
    angles: tuple[int, ...] = ()
    bound: float = LIPSCHITZ
    model: object = None


def shipped(package: Any, *methods: str) -> Iterator[type]:
    """Classes of a package with these methods, protocols left out."""
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        for _, found in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            ours = found.__module__ == module.name and not getattr(found, "_is_protocol", False)
            if ours and all(inspect.isfunction(getattr(found, name, None)) for name in methods):
                yield found


def through(position: tuple[int, int], velocity: tuple[int, int] | None, dim: int, rng: np.random.Generator) -> Any:
    """Paths of a state through the origin in several directions, or past it, standing or moving."""
    paths = []
    for angle in (0.0, 0.4, np.pi / 2, 2.5):
        u = np.array([np.cos(angle), np.sin(angle)])
        for aside in (0.0, 1e-9, 1e-6, 1e-3, 0.2):
            for speed in (0.0, 1e-6, 1.5) if velocity else (0.0,):
                state = np.zeros(dim)
                state[list(position)] = aside * np.array([-u[1], u[0]])
                if velocity:
                    state[list(velocity)] = speed * rng.normal(size=2)
                step = np.zeros(dim)
                step[list(position)] = 1.5 * u
                paths.append([state - step, state + step])
    return np.array(paths)


def pairs(rng: np.random.Generator) -> np.ndarray:
    """Paths (k, 2, 8) of pairs: through each other, through speed 0, and anywhere."""
    passing = through((0, 1), (2, 3), 8, rng)
    passing[:, :, 6:] = rng.normal(size=(len(passing), 1, 2))
    halting = np.zeros((12, 2, 8))
    halting[:, :, 4:6] = (np.array([0.0, 0.05, 8.0, -8.0])[:, None] * [1.0, 0.3]).repeat(3, axis=0)[:, None]
    halting[:, 0, 2:4], halting[:, 1, 2:4] = -np.array([6.0, 1.0]), np.array([6.0, 1.0])
    anywhere = rng.normal(size=(60, 2, 8)) * [4, 4, 4, 4, 4, 4, 4, 4]
    road = rng.normal(size=(40, 2, 8)) * [15, 1, 6, 0.5, 15, 1, 6, 0.5] + [0, 0, 8, 0, 20, 0, 8, 0]
    return np.concatenate([passing, halting, anywhere, road])


def law_case(law: Any, about: np.ndarray | None = None, paths: np.ndarray | None = None) -> Smooth:
    def at(x: np.ndarray) -> Any:
        fixed = law.alone if about is None else about
        return law.accelerations(x[:, :4], x[:, 4:], np.broadcast_to(fixed, (len(x), *np.shape(fixed))))

    found = pairs(np.random.default_rng(0)) if paths is None else paths
    return Smooth(lambda x: at(x).value, lambda x: np.concatenate(at(x)[1:], axis=-1), found)


WALL = np.array([[-5.0, 0.0, 0.0, 1.0], [0.0, 1.0, 4.0, 0.0], [4.0, 0.0, 3.0, 3.0], [3.0, 3.0, 3.0, 3.0]])


def round_the_wall() -> np.ndarray:
    """Paths along the pieces and past their ends, across them, through the corners, inside and outside."""
    rng = np.random.default_rng(1)
    ends = [WALL[:, :2] - 0.3 * (WALL[:, 2:] - WALL[:, :2]), WALL[:, 2:] + 0.3 * (WALL[:, 2:] - WALL[:, :2])]
    along = np.stack(ends, axis=1)[:3]
    across = WALL[:3, None, None, :2] + rng.normal(size=(3, 10, 1, 2)) * [[-1.0], [1.0]]
    anywhere = rng.uniform([-7, -2], [7, 5], (60, 2, 2))
    places = np.concatenate([along, across.reshape(-1, 2, 2), anywhere])
    return np.concatenate([places, np.zeros((len(places), 2, 6))], axis=2)


def motion_case(motion: Any) -> Smooth:
    rng = np.random.default_rng(2)
    dim = len(motion.components)
    still = through((2, 3), None, dim, rng)
    still[:, :, 4:] += rng.normal(size=dim - 4)
    still[::2, :, 4:] *= 1e-3
    turning = np.zeros((20, 2, dim))
    turning[:, :, 2:4] = (np.array([0.0, 1e-6, 0.1, 3.0, 15.0]).repeat(4)[:, None] * [0.8, 0.6])[:, None]
    turning[:, 0, 4:], turning[:, 1, 4:] = -2.0, 2.0
    paths = np.concatenate([still, turning, 3 * rng.normal(size=(40, 2, dim))])
    return Smooth(lambda x: motion.flow(x, 0.3), lambda x: motion.flow_jacobian(x, 0.3), paths)


def factor_case(made: Any, dim: int, others: list[np.ndarray], at: int) -> Smooth:
    """A factor by the state of its object, which passes through the origin."""

    def filled(x: np.ndarray) -> list[np.ndarray]:
        states = [np.broadcast_to(one, (len(x), *one.shape)) for one in others]
        return [*states[:at], x, *states[at:]]

    def each(x: np.ndarray, function: Callable[..., Any]) -> np.ndarray:
        return np.concatenate([function(*(state[None] for state in row)) for row in zip(*filled(x), strict=True)])

    by_state = partial(each, function=lambda *states: made.jacobians(*states)[at])
    paths = through((0, 1), None, dim, np.random.default_rng(3))[::4]
    return Smooth(partial(each, function=made.residual), by_state, paths)


def measurement_case(
    model: Any, position: tuple[int, int], velocity: tuple[int, int] | None = None, away: float = 0
) -> Smooth:
    """away: m, how far from the origin the paths lie, for models that are undefined there."""
    paths = through(position, velocity, model.state_dim, np.random.default_rng(4))
    paths[:, :, position[0]] += away
    return Smooth(model.predict, model.jacobian, paths, model.angles, 2e5 if away == 0 else LIPSCHITZ, model)


MEASUREMENTS = {
    "range": measurement_case(Range(4), (0, 1)),
    "range rate": measurement_case(RangeRate(4), (0, 1), (2, 3)),
    "bearing, past its cut": measurement_case(RangeBearing(4), (0, 1), away=-2.0),
    "radar, past its cut": measurement_case(Radar(4), (0, 1), (2, 3), away=-2.0),
}
POSE = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
CASES = {
    **{law.__name__: law_case(law()) for law in shipped(saga_fg.model, "accelerations", "given")},
    **{motion.__name__: motion_case(motion()) for motion in shipped(saga_fg.model, "flow", "flow_jacobian")},
    "SocialForce of a wall": law_case(SocialForce(), WALL, round_the_wall()),
    **MEASUREMENTS,
    "range of an object": factor_case(relative_factors([[0, 1]], [[1.0]], [[1.0]], 4, model=Range(2)), 4, [POSE], 1),
    "object from a pose": factor_case(relative_factors([[0, 1]], [[1.0, 0.1]], np.eye(2), 4), 4, [POSE], 1),
}


def test_laws_are_found_by_name_and_written_and_read_again():
    assert {"SmoothDriver", "SocialForce", "CoordinatedTurn"} <= CASES.keys()
    found = set(shipped(factors, "predict", "jacobian")) - {type(case.model) for case in MEASUREMENTS.values()}
    assert not found, "a model without a case in MEASUREMENTS"
    learned = LearnedInteractions(learned_from="two recordings", edges=TEMPLATE, explained_noise=0.5)
    assert read_settings(LearnedInteractions, write_settings(learned)) == learned


@pytest.mark.parametrize("name", CASES)
def test_gradients_are_the_derivatives_at_and_near_the_middle_of_each_path(name):
    """The middle is where the two meet, or where something stands still."""
    case = CASES[name]
    middle, half = case.paths.mean(axis=1), (case.paths[:, 1] - case.paths[:, 0]) / 2
    unit = half / np.maximum(np.abs(half).max(axis=1, keepdims=True), 1.0)
    x = np.concatenate([middle[:, None] + s * DISTANCES[:, None] * unit[:, None] for s in (-1, 1)], axis=1)
    x = x.reshape(-1, x.shape[-1])
    center = case.value(x)
    gradient = case.gradient(x)
    expected = central_differences(
        lambda y: wrap_angles(case.value(y) - center, case.angles), [x], [Vector(x.shape[-1])]
    )[0]
    scale = np.maximum(1.0, np.abs(gradient).max(axis=(1, 2), keepdims=True))
    np.testing.assert_allclose(gradient / scale, expected / scale, atol=2e-4)


@pytest.mark.parametrize("name", CASES)
def test_gradients_do_not_jump_along_paths(name):
    """Halves each interval of a path on the side where the gradient changes more, until a jump would be all."""
    case, share = CASES[name], np.linspace(0.0, 1.0, INTERVALS + 1)
    if "of an object" in name or "pose" in name:
        share = share[:: INTERVALS // 20]
    start, step = case.paths[:, 0], case.paths[:, 1] - case.paths[:, 0]
    length = np.linalg.norm(step, axis=1)

    def at(s: np.ndarray) -> np.ndarray:  # s (k, n)
        x = start[:, None] + s[..., None] * step[:, None]
        found = case.gradient(x.reshape(-1, x.shape[-1]))
        return found.reshape(*s.shape, -1)

    low, high = (np.tile(s, (len(start), 1)) for s in (share[:-1], share[1:]))
    below, above = at(low), at(high)
    scale = max(1.0, float(np.abs(below).max()))
    for _ in range(HALVINGS):
        width = (high - low)[:, :1] * length[:, None]
        change = np.abs(above - below).max(axis=-1)
        assert (change <= case.bound * width + 1e-9 * scale).all(), "the gradient is too steep"
        middle = (low + high) / 2
        between = at(middle)
        first = np.abs(between - below).max(axis=-1) >= np.abs(above - between).max(axis=-1)
        low, high = np.where(first, low, middle), np.where(first, middle, high)
        below, above = np.where(first[..., None], below, between), np.where(first[..., None], between, above)
    assert np.abs(above - below).max() <= 1e-6 * scale


def test_two_at_one_place_do_not_push_and_a_bearing_of_the_sensor_itself_is_refused():
    here = np.array([[1.0, 2.0, 0.5, 0.1]])
    for law in (SocialForce(), SmoothDriver()):
        assert (law.accelerations(here, here, law.alone[None]).value == 0).all()
    # No bearing is continuous there.
    for model in (RangeBearing(2), Radar(4)):
        with pytest.raises(FactorError, match="a bearing has no derivative"):
            model.jacobian(np.zeros(model.state_dim))


def test_distances_are_exact_beyond_their_width_and_walls_however_cut():
    d = np.array([[0.3, 0.0], [0.0, -0.31], [3.0, 4.0], [0.2999999, 0.0], [0.1, 0.0], [0.0, 0.0]])
    soft, length = soft_distance(d, 0.3), np.hypot(*d.T)
    assert (soft.value[:3] == length[:3]).all()
    assert (soft.direction[:3] == d[:3] / length[:3, None]).all()
    np.testing.assert_allclose(soft.value[3:], [0.2999999, 0.3 / 8 * (3 + 6 / 9 - 1 / 81), 0.1125], atol=1e-9)
    assert (soft.value >= length).all()
    assert (np.linalg.norm(soft.direction, axis=1) <= 1 + 1e-15).all()
    # A straight wall in two pieces is the wall in one, and missing pieces, far away, do not act.
    law, p = SocialForce(), np.random.default_rng(6).uniform([-3, 0.3], [3, 3], (30, 2))
    own, still = np.concatenate([p, np.zeros_like(p)], axis=1), np.zeros((30, 4))
    whole, cut = np.array([[-5.0, 0, 5, 0]]), np.array([[-5.0, 0, 0, 0], [0, 0, 5, 0]])
    far = np.array([[-5.0, 0, 5, 0], [1e6, 1e6, 1e6, 1e6]])
    one, two, three = (law.accelerations(own, still, np.broadcast_to(w, (30, *w.shape))) for w in (whole, cut, far))
    np.testing.assert_array_equal(one.value, three.value)
    np.testing.assert_allclose(one.value, two.value, atol=0.04)


# Edge rules that would drive objects apart are refused, alone and together

CONVOY = CarFollowing(time_constant=1.0)


def test_rules_are_tried_as_often_and_together_as_nodes_may_meet_them():
    rule = Neighbours(CONVOY, rate=0.3, max_degree=1)
    require_stable([rule])
    with pytest.raises(InputError, match=r"edges\[0\]: expected stable steps, .* up to 1\.8 1/s, the highest sum"):
        require_stable([dataclasses.replace(rule, max_degree=6)])
    rule = Neighbours(CONVOY, rate=1.0, max_degree=1)
    require_stable([rule])
    with pytest.raises(InputError, match=r"edges\[0\], edges\[1\]: expected stable steps, .* up to 2 1/s"):
        require_stable([rule, rule])
    one = Neighbours(CONVOY, rate=1.0, max_degree=1)
    apart = [dataclasses.replace(one, classes=(name,)) for name in ("car", "bus")]
    require_stable(apart)


def test_the_configuration_names_the_rules():
    text = "tracker: {{edges: [{{kind: attached}}], max_step: {step}}}"
    assert read_settings(TrackConfig, text.format(step=0.25), "mine.yaml").tracker.max_step == 0.25
    with pytest.raises(InputError, match=r"mine\.yaml: tracker: edges\[0\]: expected stable steps"):
        read_settings(TrackConfig, text.format(step=1.0), "mine.yaml")
    with pytest.raises(InputError, match=r"edges\[0\], edges\[1\]: expected stable"):
        TrackerSettings(edges=(Neighbours(CONVOY, rate=0.25), Neighbours(CONVOY, rate=0.25)))


@settings(max_examples=15)
@given(
    st.integers(0, 1000),
    st.floats(0.01, 3.0),
    st.floats(0.5, 10.0) | st.just(math.inf),
    st.sampled_from([0.1, 0.5, 1.0]),
)
def test_what_is_let_pass_does_not_grow_on_scattered_nodes(seed, rate, tau, dt):
    """Crowds of nodes, each with many neighbours: not only the pairs that were tried."""
    rules = (Neighbours(CarFollowing(tau), rate=rate), Neighbours(SharedVelocity(), rate=rate))
    try:
        require_stable(rules)
    except InputError:
        return
    rng = np.random.default_rng(seed)
    n = 8
    heading = rng.uniform(-0.4, 0.4, n)
    velocity = 5 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    car = NodeType("car", ConstantVelocity(1.0))
    position = rng.uniform(0, 12, (n, 2))
    names = np.full(n, "car")
    nodes = NodeTable(np.arange(n), names, (car,) * n, position, velocity, heading, np.full(n, 4.0), np.ones(n))
    F = discretise(build_graph(nodes, rules), dt).F_matrix.toarray()
    assert np.abs(np.linalg.eigvals(F)).max() < 1 + 1e-3


def test_highest_rates_are_sums_over_the_edges_of_a_node():
    assert highest_rate(Neighbours(rate=0.5, max_degree=3)) == 1.5
    assert highest_rate(Following(rate=0.7)) == 0.7


# The file of learned interactions, and the rules that may stand in it


def test_a_mistake_in_the_file_is_named(subtests):
    for text, message in [
        ("version: 2", "version: expected 1"),
        ("format: something", "format: expected one of"),
        ("edges: [{kind: following, rate: 50.0}]", r"edges\[0\].rate: expected at most 20 1/s, got 50"),
        ("edges: [{kind: neighbours, rate: -1.0}]", "rate: expected a finite number >= 0"),
        (
            "edges: [{kind: neighbours, interaction: {kind: car_following, time_constant: 0.1}, rate: 5.0}]",
            r"edges\[0\]: expected stable steps, what two nodes .* grows by the factor",
        ),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            read_settings(LearnedInteractions, text, "mine.yaml")


def test_dynamics_that_run_away_are_refused():
    @dataclasses.dataclass(frozen=True)
    class Flight:
        """Nodes flee: the velocity grows."""

        needs = ((), ())

        def triples(self, nodes, target, source):
            return velocity_triples(nodes, target, source, by_velocity=np.eye(2))

    with pytest.raises(InputError, match=r"edges\[0\]: expected stable dynamics"):
        LearnedInteractions(edges=(Neighbours(Flight(), rate=1.0),))
