"""Each kernel gives, compiled, what the same function gives as plain Python, wherever random frames and graphs call it.

`NUMBA_DISABLE_JIT=1` runs kernels as that plain Python; see `test_compilation`.
"""

from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.config import load_config
from saga_fg.estimators import JointKalmanFilter
from saga_fg.kernels import compilation
from saga_fg.kernels.compilation import Kernel
from saga_fg.kernels.paths import path_meetings
from tests.saga_fg.estimator_scenario import random_scenario, tell
from tests.saga_fg.kernels.test_kernels import random_frames

compared: Counter[str] = Counter()


def numbers(value):
    """All arrays and numbers of a result, in order."""
    return [leaf for each in value for leaf in numbers(each)] if isinstance(value, tuple) else [np.asarray(value)]


def both(self, *args, **named):
    name, expected = self.source.__name__, self.load()(*args, **named)
    with np.errstate(all="ignore"):
        plain = self.source(*args, **named)
    compared[name] += 1
    for one, other in zip(numbers(expected), numbers(plain), strict=True):
        if one.dtype.kind == "f":
            size = max(np.abs(other[np.isfinite(other)]).max(initial=0.0), 1e-3)
            np.testing.assert_allclose(one / size, other / size, rtol=1e-11, atol=1e-12, err_msg=name)
        else:
            np.testing.assert_array_equal(one, other, err_msg=name)
    return expected


@given(st.sampled_from(["nuscenes", "kitti", "traffic", "file"]), st.integers(0, 10_000))
@settings(max_examples=8, deadline=None, derandomize=True)
def track(family, seed):
    tracker = load_config(family).new_tracker("saga")
    for frame in random_frames(seed, frames=8):
        tracker.step(frame)


@given(st.integers(0, 10_000), st.sampled_from([{}, {"tolerance": 0.02, "max_component": 3}]))
@settings(max_examples=4, deadline=None, derandomize=True)
def play(seed, bounds):
    scenario = random_scenario(np.random.default_rng(seed), frames=4)
    estimator = tell(JointKalmanFilter(**bounds), scenario.calls)
    for node in estimator.nodes:
        estimator.covariance([node])


def meet():
    rng = np.random.default_rng(0)
    turn = np.cumsum(rng.normal(0, 0.05, (12, 40)), axis=1) + rng.uniform(-np.pi, np.pi, (12, 1))
    points = rng.uniform(-20, 20, (12, 1, 2)) + np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=-1), axis=1)
    pair, _ = path_meetings(points, rng.integers(5, 41, 12), 1.5, 1.0)
    assert 0 < len(pair) < 66


def test_all_kernels_give_compiled_what_they_give_as_plain_python(monkeypatch):
    monkeypatch.setattr(Kernel, "__call__", both)
    track()
    play()
    meet()
    assert {each.source.__name__ for each in compilation._kernels} - set(compared) == set()
