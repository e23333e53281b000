"""Laws 1, 3 and 6 of the running graph for every back end that takes providers: they agree, and what goes in acts."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from factors import (
    ResidualFactors,
    Robust,
    SolverSettings,
    gaussian_factor,
)
from saga_fg import Tracker, TrackerSettings
from saga_fg.conformance.programs import CAR, POLE, TRAM, Add, TextbookEstimator, random_program
from saga_fg.estimators import GraphFilter, JointKalmanFilter
from saga_fg.graph import EGO_POSE, LANDMARK, MAP_NODE, OBJECT, Additions, GraphError, NewVariable
from saga_fg.model.edge_rules import Following, Neighbours
from tests.saga_fg.tracking.test_tracker_road import SENSORS, queue_frames
from tests.saga_fg.tracking.test_tracker_road import SETTINGS as ROAD
from tests.saga_fg.traffic_frames import run, seen, straight

BACK_ENDS = {
    "kalman": JointKalmanFilter,
    "isam2": GraphFilter,
    "fixed-lag": lambda providers: GraphFilter(providers, 1.0),
}
EXACT = 1e-9
ORIGIN = np.zeros(2)


class Surroundings:
    """A vehicle whose place is a vector, by odometry and now and then GPS; a post, and objects seen from it and from
    each other: everything linear."""

    name = "surroundings"

    def __init__(self):
        self.post = None

    def factors(self, view):
        rng, eye = np.random.default_rng(round(1e6 * view.time)), np.eye(2)
        here, post = view.key(EGO_POSE, 0), view.key(LANDMARK, 3, static=True)
        new, factors = [], []
        known, before = view.static(LANDMARK), {}
        if 0 not in view.now(EGO_POSE):
            before = view.before(EGO_POSE)
            new.append(NewVariable(EGO_POSE, 0, rng.normal(size=2)))
            if before:
                driven = [rng.normal(0.0, 0.1, 2) + view.time - before[0].time, 0.04 * eye]
                factors.append(gaussian_factor([here, before[0].key], [eye, -eye], *driven))
        if not before or rng.random() < 0.3:
            factors.append(gaussian_factor([here], [eye], rng.normal(size=2) + view.time, eye))
        if known:
            self.post = np.append(view.state(post), view.covariance(post).ravel())
        else:
            new.append(NewVariable(LANDMARK, 3, np.zeros(2), static=True))
        factors.append(gaussian_factor([post, here], [eye, -eye], rng.normal(0, 0.1, 2) + 5 - view.time, 0.01 * eye))
        objects = [one for _, one in sorted(view.now(OBJECT).items())]
        for one, other in itertools.pairwise(objects):
            H = [np.eye(2, one.dim), -np.eye(2, other.dim)]
            if one.id % 2:
                factors.append(gaussian_factor([one.key, other.key], H, rng.normal(0, 3, 2), 0.5 * eye))
            else:
                factors.append(gaussian_factor([one.key, here], [H[0], -eye], rng.normal(0, 3, 2), 0.5 * eye))
        return Additions(new, factors)


@pytest.mark.parametrize("name", ["isam2", "fixed-lag"])
@pytest.mark.parametrize("seed", range(2))
def test_linear_factors_of_providers_lead_to_one_estimate(seed, name):
    """Objects, the vehicle and a landmark: new and leaving nodes, factors that couple components. Providers are asked
    again at the same time when nodes have left."""
    told = [Surroundings(), Surroundings()]
    kalman, other = JointKalmanFilter(told[:1]), BACK_ENDS[name](told[1:])
    apart = TextbookEstimator()
    for operation in random_program(np.random.default_rng(seed), moments=8, kinds=(CAR, TRAM, POLE)):
        for estimator in (kalman, other, apart):
            operation.run(estimator)
        if not isinstance(operation, Add):
            for estimator in (kalman, other):
                estimator.set_frame(None, ORIGIN)
                estimator.ask_providers()
        nodes = apart.nodes
        assert kalman.nodes.tolist() == other.nodes.tolist()
        P = kalman.joint_covariance(nodes)
        mean = kalman.joint_mean(nodes)
        off = np.abs((other.joint_mean(nodes) - mean) / np.sqrt(np.diag(P))).max(initial=0.0)
        assert off < 2 * EXACT  # each may be EXACT off the textbook's
        assert np.linalg.norm(other.joint_covariance(nodes) - P) <= EXACT * np.linalg.norm(P)
    assert told[0].post == pytest.approx(told[1].post, rel=1e-8, abs=1e-9)
    assert np.abs(mean - apart.joint_mean(nodes)).max() > 0.01


@pytest.mark.parametrize("name", BACK_ENDS)
def test_the_graph_says_what_the_estimator_knows(name):
    """Law 4: readable names, and solved on its own it comes to the estimate."""
    estimator = BACK_ENDS[name]([Surroundings()])
    for operation in random_program(np.random.default_rng(7), moments=4, kinds=(CAR,)):
        operation.run(estimator)
        estimator.set_frame(None, ORIGIN)
        estimator.ask_providers()
    graph = estimator.graph().copy()
    nodes = estimator.nodes.tolist()
    newest = graph.of(OBJECT, graph.epoch)
    assert set(nodes) <= newest.keys()
    assert {"landmark 3", f"ego pose 0 at {estimator.time:.2f} s"} <= set(map(str, graph.variables.values()))
    graph.solve(SolverSettings(tolerance=1e-10))
    for node in nodes:
        sigma = np.sqrt(np.diag(estimator.covariance([node])[0]))
        assert np.abs((graph.state(newest[node].key) - estimator.mean([node])[0]) / sigma).max() < 1e-7


CARS = straight([(0.0, 3.0), (9.0, 3.2), (0.0, -40.0)], [(1.2, 0.4), (1.2, 0.4), (1.0, 0.0)])
FRAMES = seen(np.random.default_rng(0), CARS, np.arange(12) / 10)


EDGES = (Following(), Neighbours())


def tracker(name, *providers, edges=EDGES, **settings):
    return Tracker(TrackerSettings(estimator=name, edges=edges, **settings), providers=providers)


class Given:
    """The factors that a function of the view and its objects gives."""

    name = "user"

    def __init__(self, function):
        self.function = function

    def factors(self, view):
        return Additions(factors=self.function(view, list(view.now(OBJECT).values())))


def tape(view, objects):
    """A tape measure to the first one."""
    far = [[one.key] for one in objects[:1]]
    residual = lambda x: np.hypot(*(x[:, :2] + view.origin).T)[:, None] - 4.0  # noqa: E731
    return [ResidualFactors(far, (4,), residual, [[0.01]], name="range")]


def towed(view, objects):
    """The second one is towed by the first: linear, on both."""
    H = np.eye(4)
    return [gaussian_factor([one.key for one in objects[:2]], [H, -H], [-8.0, 0, 0, 0], 0.2 * H)] if objects[1:] else []


def state(tracks):
    return np.concatenate([tracks.boxes.position[:, :2], tracks.boxes.velocity], axis=1)


@pytest.mark.parametrize("name", BACK_ENDS)
def test_a_users_range_and_the_interactions_change_what_the_tracker_reports(name):
    told, untold = run(tracker(name, Given(tape)), FRAMES)[-1], run(tracker(name), FRAMES)[-1]
    assert told.id.tolist() == untold.id.tolist()
    ranges = [np.hypot(*tracks.boxes.position[0, :2]) for tracks in (told, untold)]
    assert abs(ranges[0] - 4.0) < 0.3 * abs(ranges[1] - 4.0)
    moved = np.abs(state(told) - state(untold)).max(axis=1)
    assert moved[1] > 1e-3, "neighbours share their velocity"
    assert moved[2] < 1e-3 * moved[1], "that one is far away"
    together, alone = (run(tracker(name, Given(tape), edges=edges), FRAMES)[-1] for edges in (EDGES, ()))
    assert np.abs(state(together) - state(alone))[:2].max() > 1e-3


@pytest.mark.parametrize("name", BACK_ENDS)
def test_nodes_of_a_road_map_are_variables_beside_the_tracks(name):
    """Lights, lines and lanes stand still, so that each keeps one variable; cars brake for a line that is moved."""
    seen_by = []

    def line(view, objects, there=None):
        nodes = view.now(MAP_NODE)
        seen_by.append(sorted(map(str, nodes.values())))
        keys = [key for number in nodes if view.variables[key := view.key(MAP_NODE, number)].label == "stop_line"]
        return [gaussian_factor([key], [np.eye(2)], there - view.origin) for key in keys if there is not None]

    settings = replace(ROAD, estimator=name)
    plain, told, moved = (
        run(Tracker(settings, SENSORS, providers=providers), list(queue_frames()))[-1]
        for providers in ([], [Given(line)], [Given(partial(line, there=np.array([-8.0, 0.0])))])
    )
    assert told.id.tolist() == plain.id.tolist()
    assert np.abs(state(told) - state(plain)).max() < 1e-6
    assert np.abs(state(moved) - state(plain)).max() > 0.05
    assert [name.split(" at")[0] for name in seen_by[-1]] == ["lane 3", "stop_line 2", "traffic_light 1"]


def test_in_the_kalman_filter_robust_losses_are_weighted_at_the_prediction():
    """Far off, a range counts next to nothing."""

    def far(view, objects, robust=Robust("cauchy", 1.0)):  # noqa: B008 -- a value
        rows = [[one.key] for one in objects[:1]]
        return [ResidualFactors(rows, (4,), lambda x: x[:, :1] - 500.0, [[0.01]], robust=robust)]

    plain, robust, untold = (
        run(tracker("kalman", *providers), FRAMES)[-1]
        for providers in ([Given(lambda *a: far(*a, robust=None))], [Given(far)], [])
    )
    assert np.abs(state(robust) - state(untold)).max() < 0.05
    assert len(plain) != len(untold) or np.abs(state(plain) - state(untold)).max() > 10.0


def past(view, objects):
    """Nobody moves: on the states of two epochs."""
    pairs = [(one, view.before(OBJECT)[one.id]) for one in objects if one.id in view.before(OBJECT)]
    return [gaussian_factor([a.key, b.key], [np.eye(4), -np.eye(4)], np.zeros(4)) for a, b in pairs]


class Named:
    name = "user"

    def factors(self, view):
        rows = [one.key for one in view.now(OBJECT).values()]
        return Additions(named={"tape": [gaussian_factor(rows[:1], [np.eye(4)], np.zeros(4))] if rows else []})


@pytest.mark.parametrize(
    ("provider", "message"),
    [
        (
            Given(past),
            "user: linear factor on car 1 at 0.10 s, car 1 at 0.00 s: expected the newest states, car 1 at 0.00",
        ),
        (Named(), "user: linear factor on car 1 at 0.00 s: expected no name to replace it by"),
    ],
)
def test_what_the_kalman_filter_does_not_take_is_refused_by_name(provider, message):
    """With the estimators that take it, which do."""
    with pytest.raises(GraphError, match=f"provider {message}.* isam2 and fixed-lag take this one"):
        run(tracker("kalman", provider), FRAMES[:2])
    for name in ("isam2", "fixed-lag"):
        run(tracker(name, provider), FRAMES)
