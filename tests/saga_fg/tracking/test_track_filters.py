"""Filters of a track: boxes, standing still, turn rates and range rates."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes, Detection, Detections, Frame, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import Extrinsics, NoiseModel
from saga_fg.numerics.geometry import wrap_angle, yaw_transform
from saga_fg.tracking.track_filters import (
    DEVIATION,
    DRIFT,
    HEIGHT_DRIFT,
    NOISE_SCALE,
    START_RATE,
    STOP_RATE,
    STRAIGHT,
    TURNING,
    BoxFilter,
    Kinematics,
    Stationarity,
    TurnRate,
)
from tests.saga_fg.traffic_frames import (
    frame,
)

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


def test_sizes_are_means_weighted_by_probability_that_forget():
    sizes = np.array([[4.0, 2.0, 1.5], [5.0, 2.2, 1.4], [4.4, 1.8, 1.7]])
    weights = np.array([0.5, 0.9, 0.2])
    box = new_box(sizes[0], weights[0])
    for size, weight in zip(sizes[1:], weights[1:], strict=True):
        update(box, size, weight)
    assert box.size[0] == pytest.approx(np.average(sizes, axis=0, weights=weights))
    box = new_box(size=(1.0, 1.0, 1.0))
    for _ in range(200):
        update(box, size=(4.0, 2.0, 1.5))
    for _ in range(200):
        update(box, size=(8.0, 3.0, 3.0))
    assert box.size[0] == pytest.approx([8.0, 3.0, 3.0], rel=0.02)


def test_unknown_sizes_count_for_nothing():
    box = new_box(size=(NAN, NAN, NAN), weight=0.9)
    assert np.isnan(box.size).all()
    update(box, size=(NAN, NAN, NAN), weight=0.9)
    update(box, size=(4.0, 2.0, 1.5), weight=0.5)
    assert box.size[0].tolist() == [4.0, 2.0, 1.5]
    update(box, size=(5.0, 3.0, 2.5), weight=0.5)
    assert box.size[0] == pytest.approx([4.5, 2.5, 2.0])
    update(box, size=(NAN, 9.0, 9.0), weight=0.5)
    assert box.size[0] == pytest.approx([4.5, 2.5, 2.0])
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


def test_headings_drift_and_hidden_ones_turn_with_the_course():
    box = new_box(yaw=0.1).append(new_box(yaw=0.1)).append(new_box(yaw=0.1))
    before = np.array([[5.0, 0.0], [5.0, 0.0], [0.5, 0.0]])  # the last one all but stands
    after = np.stack([before[:, 0] * np.cos(0.2), before[:, 0] * np.sin(0.2)], axis=-1)
    box.turn_with(before, after, np.array([True, False, True]))
    assert box.yaw == pytest.approx([0.3, 0.1, 0.1])
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


def test_fronts_are_where_most_detections_or_a_clear_motion_say():
    box = new_box(yaw=3.0, weight=0.9)  # the first one is wrong
    update(box, yaw=3.0 - np.pi, weight=0.8)
    assert float(wrap_angle(box.yaw[0] - 3.0)) == pytest.approx(0, abs=1e-9)
    update(box, yaw=3.0 - np.pi, weight=0.8)
    assert float(wrap_angle(box.yaw[0] - 3.0)) == pytest.approx(-np.pi, abs=1e-9)
    for _ in range(20):
        update(box, yaw=3.0 - np.pi, weight=0.9)
    update(box, yaw=3.0, weight=0.9)  # one wrong one changes nothing
    assert float(wrap_angle(box.yaw[0] - 3.0)) == pytest.approx(-np.pi, abs=1e-9)
    box = new_box(yaw=0.0, weight=0.9)
    box.face_motion(np.array([[-5.0, 0.0]]))
    update(box, yaw=0.0, weight=0.9)
    assert abs(float(wrap_angle(box.yaw[0]))) == pytest.approx(np.pi)
    box.face_motion(np.zeros((1, 2)))
    assert abs(float(wrap_angle(box.yaw[0]))) == pytest.approx(np.pi)


# The belief that an object stands, and what follows from it

SETTINGS = TrackerSettings(edges=(), stationary_share=0.5)


def kinematics(position=(0.0, 0.0), velocity=(0.0, 0.0), P=0.04, P_velocity=4.0):
    return Kinematics(np.array([position]), np.array([velocity]), P * np.eye(2)[None], P_velocity * np.eye(2)[None])


def test_the_belief_is_that_of_bayes():
    stationarity = Stationarity.initiated(kinematics(), np.array([0.3]))
    z, R = np.array([[0.5, 0.0, 0.0, 0.0]]), 0.01 * np.eye(4)[None]
    moving = kinematics(position=(0.6, 0.0), P=0.09)
    stationarity.update(np.array([0]), z, R, moving, np.array([False]))

    def density(distance, variance):
        return np.exp(-(distance**2) / (2 * variance)) / variance

    expected = 0.3 * density(0.5, 0.05) / (0.3 * density(0.5, 0.05) + 0.7 * density(0.1, 0.10))
    assert stationarity.probability.item() == pytest.approx(expected)
    assert stationarity.position[0] == pytest.approx([0.5 * 0.04 / 0.05, 0.0])
    assert stationarity.P[0] == pytest.approx((0.04 - 0.04**2 / 0.05) * np.eye(2))


def test_a_measured_velocity_is_evidence_and_believed_of_a_new_track():
    stationarity = Stationarity.initiated(kinematics(), np.array([0.5]))
    still = np.zeros((1, 4))
    stationarity.update(np.array([0]), still, np.eye(4)[None] * 0.04, kinematics(P=0.04), np.array([True]))
    assert stationarity.probability.item() == pytest.approx(1 / (1 + 0.04 / 4.04)), "the positions say nothing"
    fast = frame(0.0, [(0.0, 0.0)], velocity=(12.0, 0.0))
    tracks = Tracker(SETTINGS, {"default": Sensor()}).step(fast)
    assert tracks.boxes.velocity[0] == pytest.approx([12.0, 0.0], abs=0.05)


@given(s=st.floats(0, 1), dt=st.floats(0.01, 5), share=st.floats(0.1, 0.9))
def test_what_time_does_does_not_depend_on_how_often_one_looks(s, dt, share):
    at_once, in_two = (Stationarity.initiated(kinematics(), np.array([s])) for _ in range(2))
    at_once.predict(dt, kinematics())
    in_two.predict(share * dt, kinematics())
    in_two.predict((1 - share) * dt, kinematics())
    assert in_two.probability.item() == pytest.approx(at_once.probability.item())
    at_once.predict(1e6, kinematics())
    halting = STOP_RATE / (1 + 4.0)  # velocities of variance 4 about 0 are slow with the chance 1 / 5
    assert at_once.probability.item() == pytest.approx(halting / (START_RATE + halting)), (
        "the balance of starts and stops"
    )


def test_fast_objects_do_not_halt_and_one_that_has_is_where_the_joint_filter_has_it():
    stationarity = Stationarity.initiated(kinematics(), np.array([0.0]))
    stationarity.predict(2.0, kinematics(velocity=(14.0, 0.0), P_velocity=1.0))
    assert stationarity.probability.item() < 1e-12
    stationarity = Stationarity.initiated(kinematics(), np.array([0.0]))
    stationarity.predict(0.1, kinematics(position=(30.0, 4.0)))
    assert stationarity.position[0] == pytest.approx([30.0, 4.0], abs=1e-3)
    assert stationarity.P[0] == pytest.approx((0.04 + 0.1 * DRIFT**2) * np.eye(2))


def test_what_is_reported_is_the_mean_and_the_covariance_of_the_mixture():
    stationarity = Stationarity(np.zeros((1, 2)), np.eye(2)[None], np.array([0.25]))
    assert stationarity.noise_scale == pytest.approx(0.75 + 0.25 * NOISE_SCALE)
    moving = kinematics(position=(8.0, 0.0), velocity=(4.0, 0.0), P=2.0, P_velocity=1.0)
    detected, unseen = (stationarity.reported(moving, np.array([coasting])) for coasting in (False, True))
    assert detected.position[0] == pytest.approx([8.0, 0.0])
    assert detected.P[0] == pytest.approx(2.0 * np.eye(2))
    assert unseen.position[0] == pytest.approx([6.0, 0.0])
    assert unseen.P[0] == pytest.approx(np.diag([0.75 * 2 + 0.25 + 0.25 * 0.75 * 64, 0.75 * 2 + 0.25]))
    reported = detected
    assert reported.velocity[0] == pytest.approx([3.0, 0.0])
    assert reported.P_velocity[0] == pytest.approx(np.diag([0.75 + 0.25 * 0.75 * 16, 0.75]))


# Turn rates from headings

DT, RATE = 0.1, 0.3
SHARE = 0.3  # of objects that turn


def estimated(rates, noise=0.03, seed=0, flipped=0.0):
    """The filter after headings that turn by `rates` (T,), rad/s."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rates) * DT
    turn = TurnRate.initiated(np.zeros(1), np.array([noise]))
    for h in heading:
        turn.predict(DT, np.array([2.0]))
        half = np.pi * (rng.random() < flipped)
        turn.update(np.array([0]), np.array([h + half + noise * rng.normal()]), np.array([noise]))
    return turn


def known(turn):
    """The rate to predict with."""
    return turn.known(np.array([0]), SHARE)[0].item()


@pytest.mark.parametrize("flipped", [0.0, 0.5])
def test_the_rate_of_a_turn_is_found_whichever_way_round_the_boxes_are(flipped):
    turn = estimated(np.full(20, RATE), flipped=flipped)
    assert turn.rate.item() == pytest.approx(RATE, abs=0.08)
    assert known(turn) == pytest.approx(turn.rate.item(), abs=0.06), "a clear turn is hardly shrunk"


def test_mean_and_variance_are_those_of_the_mixture_of_turning_and_straight(subtests):
    for rate in [0.0, 0.05, 0.4]:
        with subtests.test(rate=rate):
            turn = estimated(np.full(20, rate))
            w, P, x = turn.rate.item(), turn.P[0, 1, 1], np.linspace(-2, 2, 40001)
            normal = lambda d, s: np.exp(-0.5 * (d / s) ** 2) / s  # noqa: E731
            density = (SHARE * normal(x, TURNING) + (1 - SHARE) * normal(x, STRAIGHT)) * normal(w - x, np.sqrt(P))
            mean = (x * density).sum() / density.sum()
            variance = ((x - mean) ** 2 * density).sum() / density.sum()
            assert [value.item() for value in turn.known(np.array([0]), SHARE)] == pytest.approx(
                [mean, variance], rel=1e-4
            )


def test_a_wild_heading_counts_little_and_unseen_a_rate_fades():
    turn = estimated(np.zeros(20))
    before = turn.rate.item()
    turn.update(np.array([0]), np.array([1.0]), np.array([0.03]))
    assert abs(turn.rate.item() - before) < 0.1
    turn = estimated(np.full(20, RATE))
    turn.predict(30.0, np.array([2.0]))
    assert turn.rate.item() == pytest.approx(0.0, abs=1e-5)
    assert turn.P[0, 1, 1] == pytest.approx(DEVIATION**2)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_two_steps_predict_as_one(share):
    one, two = (estimated(np.full(20, RATE)) for _ in range(2))
    one.predict(0.5, np.array([2.0]))
    two.predict(share * 0.5, np.array([2.0]))
    two.predict((1 - share) * 0.5, np.array([2.0]))
    for name in ("heading", "rate", "P"):
        assert getattr(two, name) == pytest.approx(getattr(one, name), abs=1e-12)


def test_first_headings_leave_a_covariance_and_none_tell_nothing():
    turn = TurnRate.initiated(np.array([np.nan]), np.array([np.pi]))
    turn.update(np.array([0]), np.array([np.nan]), np.array([np.pi]))
    assert known(turn) == 0.0
    turn.update(np.array([0]), np.array([0.5]), np.array([0.1]))
    assert turn.heading.item() == pytest.approx(0.5)
    turn = TurnRate.initiated(np.array([np.nan]), np.array([np.pi]))
    turn.predict(1.0, np.array([2.0]))
    for k in range(20):
        turn.update(np.array([0]), np.array([RATE * k * DT]), np.array([0.03]))
        assert np.linalg.eigvalsh(turn.P[0]).min() > 0
        assert abs(known(turn)) < 2 * RATE
        turn.predict(DT, np.array([2.0]))
    assert turn.rate.item() == pytest.approx(RATE, abs=0.08)


def test_beyond_two_deviations_of_its_innovation_a_heading_counts_less():
    turn = estimated(np.zeros(20))
    S = turn.P[0, 0, 0] + 0.03**2
    gains = []
    for off in (1.9, 4.0):
        after = TurnRate(turn.heading.copy(), turn.rate.copy(), turn.P.copy())
        after.update(np.array([0]), turn.heading + off * np.sqrt(S), np.array([0.03]))
        gains.append((after.heading - turn.heading).item() / (off * np.sqrt(S)))
    assert gains[0] == pytest.approx(turn.P[0, 0, 0] / S)
    assert gains[1] == pytest.approx(gains[0] / 4)


# Range rates: one component of the velocity, taken in alike by every estimator, refused where it has no meaning

RADAR = Sensor(noise={"default": NoiseModel(position=0.5, range_rate=0.1)})
RANGE_RATE_SENSORS = {"radar": RADAR, "lidar": Sensor(noise={"default": NoiseModel(position=0.3)})}


def with_rates(plain, rate, pose=None):
    detections = replace(plain.detections, range_rate=rate)
    return Frame(plain.timestamp, plain.sensor, detections, np.eye(4) if pose is None else pose)


def radar_frame(timestamp, position, rate, pose=None, **fields):
    return with_rates(frame(timestamp, position, "radar", size=(NAN,) * 3, yaw=NAN, **fields), rate, pose)


def tracker(estimator="kalman", sensors=RANGE_RATE_SENSORS):
    return Tracker(TrackerSettings(estimator=estimator), sensors)


def test_a_new_track_takes_the_component_along_the_line_of_sight():
    tracks = tracker().step(radar_frame(0.0, [(30, 40)], [10.0]))
    sight = np.array([0.6, 0.8])
    assert tracks.boxes.velocity[0] == pytest.approx(10.0 * sight, abs=0.05)
    across = np.array([-0.8, 0.6])
    P = tracks.velocity_covariance[0]
    assert 0.09**2 < sight @ P @ sight < 0.2**2
    assert across @ P @ across > 1.0


def test_lines_of_sight_begin_at_the_sensor_and_have_no_meaning_at_it():
    mounted = replace(RADAR, extrinsics=Extrinsics(x=10.0))
    pose = yaw_transform(100.0, 0.0, 0.0, np.pi / 2)  # the sensor is at (100, 10)
    tracks = tracker(sensors={"radar": mounted}).step(radar_frame(0.0, [(130, 10)], [7.0], pose))
    assert tracks.boxes.velocity[0] == pytest.approx([7.0, 0.0], abs=0.05)
    tracks = tracker().step(radar_frame(0.0, [(0, 0)], [9.0]))
    assert tracks.boxes.velocity[0].tolist() == [0.0, 0.0]


def test_wrong_range_rates_are_refused_and_need_a_place_to_be_seen_from():
    with pytest.raises(InputError, match=r"range_rate\[0\]: expected a finite number, or NaN for unknown, got inf"):
        Detections(Boxes.of(["car"], [(0, 0, 0)]), [0.5], [np.inf])
    with pytest.raises(InputError, match=r"range_rate: expected shape \(1,\), got \(2,\)"):
        Detections(Boxes.of(["car"], [(0, 0, 0)]), [0.5], [1.0, 2.0])
    table = Detections.of([Detection("car", (1, 0, 0), range_rate=1.0)])
    with pytest.raises(InputError, match="world_T_ego: expected a pose, since range_rate is along the line of sight"):
        Frame(0.0, "radar", table)
    with pytest.raises(InputError, match="range_rate: expected a finite number > 0"):
        NoiseModel(range_rate=0.0)
