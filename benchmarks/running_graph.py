"""What nonlinear interactions cost in the running graph: `OPENBLAS_NUM_THREADS=1 python benchmarks/running_graph.py`.

Vehicles in rows, each behind the next; all are seen in every frame. Milliseconds of processor time a frame, the median,
of an iSAM2 filter with linear interactions (velocities approach the leader's) and with those of the Intelligent Driver
Model, and their ratio.
"""

from __future__ import annotations

import argparse
import platform
import time
from importlib.metadata import version

import numpy as np

from factors import gaussian_factors, prior_factors
from saga_fg.estimators import IncrementalSmoother
from saga_fg.graph import OBJECT, Additions, GraphView, NewVariable
from saga_fg.nonlinear_interactions import SmoothDriver, interaction

DT, FRAMES, SKIPPED = 0.1, 30, 5
F = np.eye(4) + DT * np.eye(4, k=2)
Q = 0.3 * np.kron([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]], np.eye(2))
OWN, LEADER = F.copy(), np.zeros((4, 4))
OWN[2:, 2:] *= 0.95
LEADER[2:, 2:] = 0.05 * np.eye(2)


class Vehicles:
    """Rows of vehicles at 8 m/s, 14 m apart."""

    name = "vehicles"

    def __init__(self, count: int, row: int, linear: bool) -> None:
        self.ids, self.row, self.linear = np.arange(count), row, linear
        self.start = np.zeros((count, 4))
        self.start[:, 0], self.start[:, 1], self.start[:, 2] = -14.0 * (self.ids % row), 5.0 * (self.ids // row), 8.0

    def factors(self, view: GraphView) -> Additions:
        """Births in the first frame, interactions later, positions in all."""
        n = len(self.ids)
        now = np.array([view.key(OBJECT, i) for i in self.ids.tolist()], dtype=np.uint64)
        noise = 0.3 * np.random.default_rng(view.epoch).normal(size=(n, 2))
        z = self.start[:, :2] + view.time * self.start[:, 2:] + noise
        seen = gaussian_factors(now[:, None], [np.tile(np.eye(2, 4), (n, 1, 1))], z, 0.09 * np.eye(2))
        if view.epoch == 0:
            return Additions(self._new(self.start), [*prior_factors(now, self.start, 0.5 * np.eye(4)), *seen])
        before = view.before(OBJECT)
        last = np.array([before[i].key for i in self.ids.tolist()], dtype=np.uint64)
        x, law = np.stack([view.state(key) for key in last.tolist()]), interaction(SmoothDriver())
        first, behind = np.flatnonzero(self.ids % self.row == 0), np.flatnonzero(self.ids % self.row)
        eye, zero = np.eye(4), np.zeros(4)
        alone = [np.tile(M, (len(first), 1, 1)) for M in (eye, -F)]
        moved = gaussian_factors(np.stack([now[first], last[first]], axis=1), alone, np.tile(zero, (len(first), 1)), Q)
        keys = np.stack([now[behind], last[behind], last[behind - 1]], axis=1)
        start = x @ F.T
        if self.linear:
            led = [np.tile(M, (len(behind), 1, 1)) for M in (eye, -OWN, -LEADER)]
            moved += gaussian_factors(keys, led, np.tile(zero, (len(behind), 1)), Q)
            return Additions(self._new(start), [*moved, *seen])
        start[behind] = law.predict(x[behind], [x[behind - 1]], DT)
        following = law.factors(keys[:, 0], keys[:, 1], keys[:, 2:], 4, DT, Q)
        return Additions(self._new(start), [*moved, following, *seen])

    def _new(self, states: np.ndarray) -> list[NewVariable]:
        return [NewVariable(OBJECT, i, x) for i, x in zip(self.ids.tolist(), states, strict=True)]


def milliseconds(count: int, row: int, linear: bool) -> float:
    """Median processor time of a frame."""
    smoother, times = IncrementalSmoother([Vehicles(count, row, linear)]), []
    for k in range(FRAMES):
        start = time.process_time()
        smoother.step(DT * k)
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times[SKIPPED:]))


def main() -> None:
    """Print a line for each length of the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=100)
    parser.add_argument("--rows", type=int, nargs="+", default=[5, 100], help="vehicles in a row")
    arguments = parser.parse_args()
    print(f"gtsam {version('gtsam')}, numpy {np.__version__}, Python {platform.python_version()}; seeds: frame numbers")
    for row in arguments.rows:
        linear, nonlinear = (milliseconds(arguments.vehicles, row, kind) for kind in (True, False))
        print(
            f"{arguments.vehicles} vehicles in rows of {row}: linear {linear:.1f} ms, "
            f"intelligent driver {nonlinear:.1f} ms, ratio {nonlinear / linear:.2f}"
        )


if __name__ == "__main__":
    main()
