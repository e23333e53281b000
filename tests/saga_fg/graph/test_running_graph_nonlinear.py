"""Law 2 of the running graph: nothing marginalised, iSAM2 is Levenberg-Marquardt on everything; with a lag, consistent.

Scenes (`benchmarks.sampled_traffic`): intelligent drivers, pedestrians who keep apart, range and bearing, the
vehicle's own pose.
"""

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.sampled_traffic import (
    DetectionProvider,
    ObjectProvider,
    VehicleProvider,
    providers,
    sample_traffic,
)
from factors import Robust, SolverSettings
from saga_fg.estimators import IncrementalSmoother, RelinearisationSettings
from saga_fg.graph import EGO_POSE, OBJECT

EXACT = SolverSettings(tolerance=1e-7)


def off(smoother, values):
    """The largest difference of any variable, in its posterior standard deviations."""
    differences = [0.0]
    for key, variable in smoother.graph().variables.items():
        way = variable.type.local(smoother.state(key), variable.type.read(values, key))
        differences.append(np.abs(way / np.sqrt(np.diag(smoother.covariance(key)))).max())
    return max(differences)


@pytest.mark.parametrize("seed", range(12))
def test_every_frame_equals_levenberg_marquardt_on_everything(seed):
    scene = sample_traffic(np.random.default_rng(seed), frames=7, cars=3, pedestrians=2)
    smoother = IncrementalSmoother(providers(scene), lag=None)
    for moment in scene.frames:
        smoother.step(moment.time)
        whole = smoother.graph().copy()
        whole.moved_to(whole.base)  # where everything was first put
        solution = whole.solve(EXACT)
        assert solution.converged
        assert off(smoother, solution.values) < 1e-3


def test_gtsams_own_solver_finds_the_same():
    scene = sample_traffic(np.random.default_rng(0), frames=7, cars=3, pedestrians=2)
    smoother = IncrementalSmoother(providers(scene), lag=None)
    for moment in scene.frames:
        smoother.step(moment.time)
    graph, parameters = smoother.graph(), gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    found = gtsam.LevenbergMarquardtOptimizer(graph.native(), graph.base, parameters).optimize()
    assert off(smoother, found) < 1e-3


def test_robust_losses_are_weighted_anew(subtests):
    """A tenth of the detections far off; iteratively reweighted least squares comes nearer by a factor a time."""
    for seed in range(4):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            scene = sample_traffic(rng, frames=5, cars=3, pedestrians=2)
            for moment in scene.frames:
                for node in moment.seen:
                    if rng.random() < 0.1:
                        moment.seen[node] = moment.seen[node] + np.array([4.0, 0.2])
            robust, plain = (
                IncrementalSmoother(providers(scene, loss), lag=None) for loss in (Robust("cauchy", 2.0), None)
            )
            for moment in scene.frames:
                robust.step(moment.time)
                plain.step(moment.time)
                assert off(robust, robust.graph().copy().solve(EXACT).values) < 3e-3
            assert off(robust, plain.graph().values) > 0.1


@pytest.mark.parametrize("lag", [0.0, 1.0])
def test_with_a_lag_errors_are_as_large_as_their_covariance_says(lag):
    """The 99 % band of the NEES, of vehicle and objects together at the end of thirty scenes drawn from the model."""
    total, degrees = 0.0, 0
    for seed in range(30):
        scene = sample_traffic(np.random.default_rng(1000 + seed), frames=10, cars=3, pedestrians=2)
        smoother = IncrementalSmoother(providers(scene), lag=lag)
        for moment in scene.frames:
            smoother.step(moment.time)
        last, graph = scene.frames[-1], smoother.graph()
        keys = [variable.key for kind in (EGO_POSE, OBJECT) for variable in graph.of(kind, graph.epoch).values()]
        truth = {OBJECT: last.states, EGO_POSE: {0: last.pose}}
        errors = []
        for key in keys:
            variable = graph.variable(key)
            errors.append(variable.type.local(smoother.state(key), truth[variable.kind][variable.id]))
        error = np.concatenate(errors)
        total += error @ np.linalg.solve(smoother.joint_covariance(keys), error)
        degrees += len(error)
    assert chi2.ppf(0.005, degrees) < total < chi2.ppf(0.995, degrees)


@pytest.mark.parametrize("lag", [0.0, 0.5])
def test_the_graph_stays_as_large_as_the_lag(lag):
    """Factors and variables, those that iSAM2 holds among them, over 120 frames with new and leaving nodes."""
    scene = sample_traffic(np.random.default_rng(7), frames=120, cars=3, pedestrians=3, intervals=(0.1,))
    smoother, sizes = IncrementalSmoother(providers(scene), lag, RelinearisationSettings(threshold=0.1)), []
    for moment in scene.frames:
        smoother.step(moment.time)
        graph = smoother.graph()
        held = smoother._engine.isam.getFactorsUnsafe().size()
        sizes.append([len(graph.variables), sum(1 for _ in graph.factors()), held, len(smoother._engine.slots)])
        assert all(moment.time - one.time <= lag + 0.1 + 1e-9 for one in graph.variables.values())
    early, late = (np.max(sizes[part], axis=0) for part in (slice(20, 60), slice(60, 120)))
    assert (late <= 1.05 * early).all()


def test_what_goes_in_acts():
    """Without interactions the estimate is another one; so it is with a factor of the user's."""
    scene = sample_traffic(np.random.default_rng(3), frames=8)
    alone = sample_traffic(np.random.default_rng(3), frames=8)
    alone.leaders, alone.neighbours = {}, lambda node, present: []

    def newest(made):
        smoother = IncrementalSmoother(made)
        for moment in scene.frames:
            smoother.step(moment.time)
        return {one.id: smoother.state(one.key) for one in smoother.graph().of(OBJECT, 7).values()}

    together = newest([VehicleProvider(scene), ObjectProvider(scene), DetectionProvider(scene)])
    apart = newest([VehicleProvider(alone), ObjectProvider(alone), DetectionProvider(alone)])
    assert together.keys() == apart.keys()
    assert max(np.abs(together[node] - apart[node]).max() for node in together) > 0.01
