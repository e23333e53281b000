"""Size, height and heading of a track: means, a scalar filter, and a heading that may be off by half a turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tracking.track_filters import HEIGHT_DRIFT, BoxFilter

NAN = float("nan")
angles = st.floats(-3.1, 3.1)


def new_box(size=(4.0, 2.0, 1.5), weight=0.5, z=1.0, z_noise=0.2, yaw=0.0, yaw_noise=0.3):
    return BoxFilter.initiated(
        np.array([size]), np.array([weight]), np.array([z]), np.array([z_noise]), np.array([yaw]), np.array([yaw_noise])
    )


def update(box, size=(4.0, 2.0, 1.5), weight=0.5, z=1.0, z_noise=0.2, yaw=NAN, yaw_noise=0.3, row=0):
    box.update(
        np.array([row]),
        np.array([size]),
        np.array([weight]),
        np.array([z]),
        np.array([z_noise]),
        np.array([yaw]),
        np.array([yaw_noise]),
    )


def test_size_is_the_mean_weighted_by_probability():
    sizes = np.array([[4.0, 2.0, 1.5], [5.0, 2.2, 1.4], [4.4, 1.8, 1.7]])
    weights = np.array([0.5, 0.9, 0.2])
    box = new_box(sizes[0], weights[0])
    for size, weight in zip(sizes[1:], weights[1:], strict=True):
        update(box, size, weight)
    assert box.size[0] == pytest.approx(np.average(sizes, axis=0, weights=weights))


def test_the_mean_forgets_after_many_detections():
    box = new_box(size=(1.0, 1.0, 1.0))
    for _ in range(200):
        update(box, size=(4.0, 2.0, 1.5))
    for _ in range(200):
        update(box, size=(8.0, 3.0, 3.0))
    assert box.size[0] == pytest.approx([8.0, 3.0, 3.0], rel=0.02)


def test_an_unknown_size_counts_for_nothing():
    box = new_box(size=(NAN, NAN, NAN), weight=0.9)
    assert np.isnan(box.size).all()
    update(box, size=(NAN, NAN, NAN), weight=0.9)
    update(box, size=(4.0, 2.0, 1.5), weight=0.5)
    assert box.size[0].tolist() == [4.0, 2.0, 1.5]
    update(box, size=(5.0, 3.0, 2.5), weight=0.5)
    assert box.size[0] == pytest.approx([4.5, 2.5, 2.0])
    update(box, size=(NAN, 9.0, 9.0), weight=0.5)
    assert box.size[0] == pytest.approx([4.5, 2.5, 2.0])


def test_a_size_of_no_weight_leaves_an_unknown_one_unknown():
    box = new_box(size=(NAN, NAN, NAN))
    update(box, size=(NAN, NAN, NAN), weight=0.0)  # as of a track that hands over without any size
    assert np.isnan(box.size).all()


def test_height_is_a_scalar_kalman_filter():
    box = new_box(z=1.0, z_noise=0.2)
    box.predict(0.5, np.array([0.0]))
    prior = 0.2**2 + HEIGHT_DRIFT**2 * 0.5
    assert box.z_variance[0] == pytest.approx(prior)
    update(box, z=2.0, z_noise=0.1)
    gain = prior / (prior + 0.1**2)
    assert box.z[0] == pytest.approx(1.0 + gain)
    assert box.z_variance[0] == pytest.approx((1 - gain) * prior)


@given(angles, st.floats(-1.5, 1.5), st.sampled_from([0.0, np.pi, -np.pi, 2 * np.pi]))
def test_a_heading_half_a_turn_off_is_turned_to_the_side_of_the_estimate(yaw, difference, flip):
    box = new_box(yaw=yaw, yaw_noise=0.3)
    update(box, yaw=float(wrap_angle(yaw + difference + flip)), yaw_noise=0.3)
    assert float(wrap_angle(box.yaw[0] - (yaw + difference / 2))) == pytest.approx(0, abs=1e-9)
    assert box.yaw_variance[0] == pytest.approx(0.3**2 / 2)


def test_an_unknown_heading_stays_unknown_until_measured():
    box = new_box(yaw=NAN, yaw_noise=np.pi)
    update(box, yaw=NAN)
    box.face_motion(np.array([[5.0, 0.0]]))
    assert np.isnan(box.yaw).all()
    update(box, yaw=2.5, yaw_noise=0.1)
    assert box.yaw[0] == pytest.approx(2.5)
    assert box.yaw_variance[0] == pytest.approx(0.1**2)
    update(box, yaw=NAN)
    assert box.yaw[0] == pytest.approx(2.5)


def test_headings_face_a_clear_motion():
    box = new_box(yaw=0.3)
    for velocity, yaw in (
        ((-1.0, 0.0), 0.3),
        ((0.0, -5.0), 0.3),
        ((-5.0, 0.0), 0.3 - np.pi),
        ((-5.0, 0.0), 0.3 - np.pi),
    ):
        box.face_motion(np.array([velocity]))
        assert box.yaw[0] == pytest.approx(yaw)


def test_only_hidden_headings_turn_with_the_predicted_course():
    box = new_box(yaw=0.1).append(new_box(yaw=0.1)).append(new_box(yaw=0.1))
    before = np.array([[5.0, 0.0], [5.0, 0.0], [0.5, 0.0]])  # the last one all but stands
    after = np.stack([before[:, 0] * np.cos(0.2), before[:, 0] * np.sin(0.2)], axis=-1)
    box.turn_with(before, after, np.array([True, False, True]))
    assert box.yaw == pytest.approx([0.3, 0.1, 0.1])


def test_the_heading_drifts():
    box = new_box(yaw_noise=0.3)
    box.predict(2.0, np.array([0.5]))
    assert box.yaw_variance[0] == pytest.approx(0.3**2 + 0.5**2 * 2.0)


def test_only_the_rows_named_are_touched():
    box = new_box().append(new_box(z=3.0)).append(new_box(yaw=1.0))
    update(box, size=(9.0, 9.0, 9.0), z=5.0, yaw=0.2, row=1)
    assert box.size[[0, 2]].tolist() == [[4.0, 2.0, 1.5]] * 2
    assert box.z[[0, 2]].tolist() == [1.0, 1.0]
    assert box.yaw[[0, 2]].tolist() == [0.0, 1.0]
    assert box.z[1] > 3.0
    chosen = box.select(np.array([True, False, True]))
    assert chosen.yaw.tolist() == [0.0, 1.0]


def test_the_front_is_where_most_detections_say_it_is():
    box = new_box(yaw=3.0, weight=0.9)  # the first one is wrong
    update(box, yaw=3.0 - np.pi, weight=0.8)
    assert float(wrap_angle(box.yaw[0] - 3.0)) == pytest.approx(0, abs=1e-9)
    update(box, yaw=3.0 - np.pi, weight=0.8)
    assert float(wrap_angle(box.yaw[0] - 3.0)) == pytest.approx(-np.pi, abs=1e-9)
    for _ in range(20):
        update(box, yaw=3.0 - np.pi, weight=0.9)
    update(box, yaw=3.0, weight=0.9)  # one wrong one changes nothing
    assert float(wrap_angle(box.yaw[0] - 3.0)) == pytest.approx(-np.pi, abs=1e-9)


def test_a_clear_motion_outvotes_the_detections():
    box = new_box(yaw=0.0, weight=0.9)
    box.face_motion(np.array([[-5.0, 0.0]]))
    update(box, yaw=0.0, weight=0.9)
    assert abs(float(wrap_angle(box.yaw[0]))) == pytest.approx(np.pi)
    box.face_motion(np.zeros((1, 2)))
    assert abs(float(wrap_angle(box.yaw[0]))) == pytest.approx(np.pi)
