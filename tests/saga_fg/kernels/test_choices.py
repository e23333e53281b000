"""Each function that has a kernel gives what its NumPy version gives, wherever random frames and graphs call it."""

import dataclasses
from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.config import load_config
from saga_fg.kernels.compilation import Choice, choices, only_numpy
from tests.saga_fg.kernels.test_filtering import played, random_scenario
from tests.saga_fg.kernels.test_tracking import random_frames, tracked

compared: Counter[str] = Counter()


def numbers(value):
    """All arrays and numbers of a result, in order."""
    if isinstance(value, tuple | list):
        return [leaf for each in value for leaf in numbers(each)]
    if dataclasses.is_dataclass(value):
        return [leaf for field in dataclasses.fields(value) for leaf in numbers(getattr(value, field.name))]
    return [np.asarray(value)]


def name(choice):
    """The module and the name of a choice: names alone repeat."""
    return f"{choice.__module__}.{choice.__qualname__}"


def scales(values):
    """Size of each row along the last axis, that rounding is relative to; of each value of a vector."""
    size = np.where(np.isfinite(values), np.abs(values), 0.0)
    return np.maximum(size.max(axis=-1, keepdims=True) if values.ndim > 1 and values.size else size, 1e-3)


def both(self, *args, **kwargs):
    with only_numpy():
        expected = self.numpy_version(*args, **kwargs)
    if self.where is None or self.where(*args, **kwargs):
        compared[name(self)] += 1
        for one, other in zip(numbers(self.compiled(*args, **kwargs)), numbers(expected), strict=True):
            if one.dtype.kind == "f":
                size = scales(other)
                np.testing.assert_allclose(one / size, other / size, rtol=1e-8, atol=1e-9, err_msg=name(self))
            else:
                np.testing.assert_array_equal(one, other, err_msg=name(self))
    return expected


@given(st.sampled_from(["nuscenes", "kitti", "traffic", "file"]), st.integers(0, 10_000))
@settings(max_examples=24, deadline=None)
def track(family, seed):
    tracked(random_frames(seed), load_config(family))


@given(st.integers(0, 10_000), st.sampled_from([{}, {"tolerance": 0.02, "most": 3}]))
@settings(max_examples=8, deadline=None)
def play(seed, bounds):
    played(random_scenario(np.random.default_rng(seed), frames=6), bounds)


def test_both_versions_give_the_same_and_none_is_left_out(monkeypatch):
    monkeypatch.setattr(Choice, "__call__", both)
    track()
    play()
    assert {name(choice) for choice in choices} - set(compared) == set()
