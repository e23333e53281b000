"""Kernels against plain NumPy. The joint Kalman filter where numbers are hard, and partitions of its state."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from saga_fg.errors import InputError
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.estimators.partition import Partition, StateLayout, flattened, regrouped, unflattened, zeros
from saga_fg.kernels.matrix_functions import coupling_integrals
from saga_fg.model.discretisation import linear_motions
from saga_fg.numerics.arrays import distinct
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame


def test_measurements_that_are_far_better_than_what_was_known(subtests):
    """A correction that cancels is refined: the measured rows are those of the textbook."""
    for noise in [1e-3, 1e-9, 1e-14]:
        with subtests.test(noise=noise):
            estimator, z = JointKalmanFilter(), np.random.default_rng(1).normal(size=(4, 2))
            estimator.add(np.arange(5), np.zeros((5, 4)), np.tile(np.diag([1e4, 1e4, 10.0, 10.0]) + 2.0, (5, 1, 1)))
            estimator.update(Measurements([0, 1, 4, 3], z, np.eye(2, 4), noise * np.eye(2)))
            np.testing.assert_allclose(estimator.mean([0, 1, 4, 3])[:, :2], z, atol=1e-4 * noise**0.5 + 1e-9)
            measured = np.diagonal(estimator.covariance([0, 1, 4, 3]), axis1=1, axis2=2)
            np.testing.assert_allclose(measured[:, :2], noise, rtol=1e-3)
            assert (measured > 0).all()


def test_noise_lost_in_rounding_is_an_error():
    estimator = JointKalmanFilter()
    estimator.add([1], np.zeros((1, 2)), 1e20 * np.eye(2)[None])
    row = np.array([[1.0, 0.0], [1.0, 0.0]])
    measurements = Measurements([1], np.zeros((1, 2)), row, 1e-3 * np.eye(2))
    with pytest.raises(InputError, match="lost in the rounding"):
        estimator.update(measurements)


def dense(blocks, partition):
    """The whole matrix (D, D) of blocks."""
    matrix = np.zeros((partition.layout.size, partition.layout.size))
    for places, of_group in zip(partition.groups, blocks, strict=True):
        for at, block in zip(places, of_group, strict=True):
            matrix[np.ix_(at, at)] = block
    return matrix


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_partitions_and_what_is_regrouped_over_them(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 9))
    layout = StateLayout(np.arange(n), rng.choice([1, 2, 4, 6], n))
    labels = [np.unique(rng.integers(0, max(n, 1), n), return_inverse=True)[1] for _ in range(2)]
    old, new = (Partition(layout, label.astype(np.int64)) for label in labels)
    blocks = [rng.normal(size=block.shape) for block in zeros(old)]
    source = rng.integers(-1, n, n) if n else np.empty(0, dtype=np.int64)
    alike = source < 0
    alike |= layout.dims[np.maximum(source, 0)] == layout.dims
    source = np.where(alike, source, -1)
    result = regrouped(tuple(blocks), old, new, source)
    given_entries, entries = dense(tuple(blocks), old), dense(result, new)
    for i in range(n):
        for j in range(n):
            if new.label[i] != new.label[j]:
                continue
            part = entries[
                new.layout.offsets[i] : new.layout.offsets[i + 1], new.layout.offsets[j] : new.layout.offsets[j + 1]
            ]
            k, m = source[i], source[j]
            if k < 0 or m < 0 or old.label[k] != old.label[m]:
                assert not part.any()
            else:
                a, b = (slice(*old.layout.offsets[row : row + 2]) for row in (k, m))
                np.testing.assert_array_equal(part, given_entries[a, b])
    for one, other in zip(unflattened(flattened(result), new), result, strict=True):
        np.testing.assert_array_equal(one, other)


# Exponentials and their integrals against those of whole matrices


def near(one, other, tolerance=1e-11):
    """Stacks of matrices that agree up to rounding, relative to the largest entry of each."""
    assert one.shape == other.shape
    scale = np.abs(other).max(axis=(1, 2), keepdims=True, initial=1e-12)
    assert (np.abs(one - other) <= tolerance * scale).all()


def test_motions_are_those_of_the_matrix_exponential(subtests):
    """exp(A dt), and Q by the exponential of [[A, Qc], [0, -A^T]] dt (Van Loan, 1978)."""
    for d, dt in product([1, 2, 4, 6], [0.05, 1.0, 8.0]):
        with subtests.test(d=d, dt=dt):
            rng = np.random.default_rng(d)
            A, root = 0.3 * rng.normal(size=(12, d, d)), rng.normal(size=(12, d, d))
            Qc = root @ np.swapaxes(root, 1, 2)
            F, Q = linear_motions(A, Qc, dt)
            whole = expm(dt * np.block([[A, Qc], [np.zeros_like(A), -np.swapaxes(A, 1, 2)]]))
            near(F, whole[:, :d, :d])
            near(Q, whole[:, :d, d:] @ np.swapaxes(whole[:, :d, :d], 1, 2), 1e-8)


def test_integrals_of_couplings_are_corners_of_the_matrix_exponential(subtests):
    """int exp(M (dt - s)) C exp(A s) ds is the upper right block of the exponential of [[M, C], [0, A]] dt."""
    for dt in [0.05, 1.0, 4.0]:
        with subtests.test(dt=dt):
            rng = np.random.default_rng(1)
            M, A, C = rng.normal(size=(3, 4, 4)), rng.normal(size=(2, 6, 6)), rng.normal(size=(9, 4, 6))
            at, of = np.sort(rng.integers(0, 3, 9)), rng.integers(0, 2, 9)
            whole = expm(dt * np.block([[M[at], C], [np.zeros((9, 6, 4)), A[of]]]))
            near(coupling_integrals(M, at, C, A, of, dt, 12, 0.5), whole[:, :4, 4:], 1e-10)


# Random frames for tests of kernels; overlaps of boxes and numbers of labels

CLASSES = ("car", "truck", "pedestrian", "bicycle", "construction_vehicle")


def random_frames(seed, frames=12):
    """Objects of several classes that drive, stand, hide and are reported twice, and false detections."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 14))
    label = rng.choice(CLASSES, n)
    heading = rng.uniform(-0.5, 0.5, n)
    speed = np.where(rng.random(n) < 0.4, 0.0, rng.uniform(1, 15, n))
    place, hidden = rng.uniform(-25, 25, (n, 2)), rng.integers(0, frames, n)
    found = []
    for number in range(frames):
        place = place + 0.2 * speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        gone = (number >= hidden) & (number < hidden + 4) | (rng.random(n) < 0.1)
        seen = np.concatenate([np.flatnonzero(~gone), rng.choice(n, n // 5)]) if n else np.empty(0, dtype=np.int64)
        false = int(rng.integers(0, 4))
        labels = np.concatenate([label[seen], rng.choice(CLASSES, false)]).astype(np.str_)
        k = len(labels)
        z = np.zeros((k, 3))
        z[:, :2] = np.concatenate([place[seen], rng.uniform(-25, 25, (false, 2))]) + rng.normal(scale=0.2, size=(k, 2))
        yaw = np.concatenate([heading[seen], rng.uniform(-3, 3, false)])
        yaw[rng.random(k) < 0.1] = np.nan
        velocity = np.where(rng.random((k, 1)) < 0.7, rng.normal(scale=5.0, size=(k, 2)), np.nan)
        boxes = Boxes.of(labels, z, np.tile((4.0, 1.8, 1.6), (k, 1)), yaw, velocity)
        if rng.random() < 0.1:
            boxes = boxes.select(np.empty(0, dtype=np.int64))
        score = rng.uniform(0.05, 0.95, len(boxes))
        found.append(Frame(0.2 * number, "lidar", Detections(boxes, score), np.eye(4)))
    return found


def test_labels_may_change_in_place():
    label = np.array(["car", "bus"])
    assert distinct(label)[0] == ("car", "bus")
    label[0] = "bus"
    assert distinct(label)[0] == ("bus",)


@given(st.lists(st.sampled_from(["car", "cart", "ca", "bus", "Fußgänger", "construction_vehicle"])), st.booleans())
@settings(deadline=None)
def test_labels_by_number(labels, frozen):
    array = np.array(labels, dtype=np.str_)
    array.flags.writeable = not frozen
    names, number = distinct(array)
    assert names == tuple(dict.fromkeys(labels))
    assert [names[k] for k in number] == labels


# Trackers and snapshots that went through pickle, whose arrays then lie in bytes, go on with kernels
