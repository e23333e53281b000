"""What the landmark mapper costs a pose: `OPENBLAS_NUM_THREADS=1 python benchmarks/landmark_mapper.py`.

A straight drive past poles on both sides, without loops: milliseconds of processor time a pose over the whole drive and
over its last fifty poses, smoothing included, and how far off the last pose is.
"""

from __future__ import annotations

import argparse
import time

import gtsam
import numpy as np

from saga_fg.model.landmarks.pole import PoleLandmark
from saga_fg.slam.mapping import LandmarkMapper
from saga_fg.types.landmark import Observation

REACH, GAP = 25.0, 3.3  # m; between poles
Q = np.diag([0.0005, 0.0005, 0.001, 0.02, 0.01, 0.01]) ** 2
R = 0.1**2 * np.eye(2)


def run(poses: int) -> None:
    """One drive."""
    rng, kind, true = np.random.default_rng(0), PoleLandmark(), gtsam.Pose3()
    count = int(poses / GAP)
    across = rng.choice([-1, 1], count) * rng.uniform(5, 9, count)
    poles = np.column_stack([rng.uniform(0, poses + REACH, count), across, np.ones(count)])
    step = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0.0, 0.0]))
    mapper, spent = LandmarkMapper(np.eye(4), 1e-6 * np.eye(6)), []
    for _ in range(poses):
        near = poles[np.abs(poles[:, 0] - true.x()) < REACH]
        seen = [Observation(kind, true.transformTo(place) + np.append(rng.normal(0, 0.1, 2), 0.0), R) for place in near]
        motion = step.retract(rng.normal(0, np.sqrt(np.diag(Q)))).matrix()
        begin = time.process_time()
        mapper.observe(seen)
        mapper.move(motion, Q)
        spent.append(1e3 * (time.process_time() - begin))
        true = true.compose(step)
    found = mapper.map()
    off = np.linalg.norm(found.world_T_pose[-1, :3, 3] - true.translation())
    print(
        f"{poses} poses, {len(found.landmarks)} of {count} poles: {np.mean(spent):.1f} ms a pose, "
        f"{np.mean(spent[-50:]):.1f} ms at the end; {off:.2f} m off"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, nargs="+", default=[50, 700])
    for number in parser.parse_args().poses:
        run(number)
