"""What factors cost from Python: `OPENBLAS_NUM_THREADS=1 python benchmarks/factor_costs.py [--nodes N] [--seed S]`.

One step of N nodes with states of 4 numbers and 4 neighbours each. Microseconds of processor time per node (a factor
each; when solving, three), the best of several runs, and the ratio to a baseline of the same run: for native factors
GTSAM's constructor called block by block, for nonlinear ones our factors one by one, for solving GTSAM's Gauss-Newton
over `CustomFactor`s.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version

import gtsam
import numpy as np

import factors

DT = 0.1


def consensus(x: np.ndarray, others: list[np.ndarray], dt: float) -> np.ndarray:
    """Neighbours' speeds pull ours, the more the closer they are."""
    a = np.zeros_like(x[..., 2:])
    for other in others:
        near = np.exp(-((other[..., :2] - x[..., :2]) ** 2).sum(axis=-1, keepdims=True) / 100.0)
        a = a + 0.1 * near * (other[..., 2:] - x[..., 2:])
    v = x[..., 2:] + a * dt
    return np.concatenate([x[..., :2] + v * dt, v], axis=-1)


def best(run: Callable[[], object], repeats: int = 7) -> float:
    """Seconds of processor time of the fastest run."""
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        run()
        times.append(time.thread_time() - start)
    return min(times)


def linearise_all(singles: Sequence[factors.Linearisable], values: gtsam.Values) -> None:
    """One factor after the other."""
    for factor in singles:
        factor.linearise(values)


def report(name: str, seconds: float, n: int, baseline: float) -> None:
    print(f"{name:70s} {1e6 * seconds / n:9.1f} us {seconds / baseline:8.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    n, rng = given.nodes, np.random.default_rng(given.seed)
    print(f"gtsam {version('gtsam')}, numpy {np.__version__}, python {platform.python_version()}, seed {given.seed}")
    print(f"{f'{n} nodes, 4 neighbours, states of 4':70s}     per node    ratio")

    now, later = np.arange(n), n + np.arange(n)
    near = np.stack([(now + shift) % n for shift in (1, 2, 3, 5)], axis=1)
    keys = np.column_stack([now, near])
    F, b, Q = rng.normal(size=(n, 5, 4, 4)), rng.normal(size=(n, 4)), np.tile(0.1 * np.eye(4), (n, 1, 1))
    unit = gtsam.noiseModel.Unit.Create(4)
    terms = [
        [(int(later[i]), np.eye(4)), *((int(key), block) for key, block in zip(keys[i], F[i], strict=True))]
        for i in range(n)
    ]
    flat, indptr = F.reshape(-1, 4, 4), 5 * np.arange(n + 1)

    def step() -> list[gtsam.JacobianFactor]:
        return factors.interaction_factors(later, keys.ravel(), indptr, flat, b, Q)

    blockwise = best(lambda: [gtsam.GaussianConditional(terms[i], 0, b[i], unit) for i in range(n)])
    report("GTSAM's constructor, unwhitened, unchecked", blockwise, n, blockwise)
    report("interaction_factors", best(step), n, blockwise)
    native, dims = step(), dict.fromkeys(range(2 * n), 4)
    report("  wrapped by nonlinear_graph", best(lambda: factors.nonlinear_graph(native, dims)), n, blockwise)
    report("prior_factors", best(lambda: factors.prior_factors(now, b, Q)), n, blockwise)
    camera, noise = factors.position(4), np.eye(2)
    positions = best(lambda: factors.linear_detection_factors(later, camera, b[:, :2], noise))
    report("linear_detection_factors", positions, n, blockwise)
    alone = best(lambda: [factors.prior_factor(i, b[i], Q[i]) for i in range(n)], 3)
    report("prior_factor, one by one", alone, n, blockwise)

    values = gtsam.Values()
    for key in range(2 * n):
        values.insert(key, 10 * rng.normal(size=4))
    radar, R = factors.Radar(4, sensor_pose=(-60.0, 0.0, 0.0)), np.diag([0.1, 0.01, 0.1])
    z = radar.predict(10 * rng.normal(size=(n, 4)))
    interaction = factors.NonlinearInteraction(consensus)
    pairs = {
        "radar detections": (
            [factors.detection_factor(int(later[i]), radar, z[i], R) for i in range(n)],
            factors.detection_factors(later, radar, z, R),
        ),
        "nonlinear interactions, numerical Jacobians": (
            [interaction.factor(int(later[i]), i, near[i].tolist(), 4, DT, Q[i]) for i in range(n)],
            interaction.factors(later, now, near, 4, DT, Q),
        ),
    }
    for name, (singles, together) in pairs.items():
        separate = best(partial(linearise_all, singles, values), 3)
        report(f"{name}: linearise one by one", separate, n, separate)
        report(f"{name}: together", best(partial(together.linearise, values)), n, separate)

    priors = factors.nonlinear_graph(factors.prior_factors(now, b, np.eye(4)), dims)
    ours = [factor for singles, _ in pairs.values() for factor in singles]
    families = [family for _, family in pairs.values()]
    once = factors.SolverSettings("gauss-newton", max_iterations=3, tolerance=1e-300)
    custom = priors.clone()
    for factor in ours:
        custom.add(factor.as_custom_factor())
    params = gtsam.GaussNewtonParams()
    params.setMaxIterations(3)
    params.setRelativeErrorTol(0.0)
    params.setAbsoluteErrorTol(0.0)
    theirs = best(lambda: gtsam.GaussNewtonOptimizer(custom, values, params).optimize(), 1)
    report("GTSAM's Gauss-Newton over CustomFactors, per iteration", theirs / 3, n, theirs / 3)
    report("solve, factors one by one", best(lambda: factors.solve(priors, ours, values, once), 1) / 3, n, theirs / 3)
    report("solve, factors together", best(lambda: factors.solve(priors, families, values, once), 3) / 3, n, theirs / 3)


if __name__ == "__main__":
    main()
