"""Wrong clocks among right ones: they shut out their own sensor only, and are corrected by objects in common."""

import copy
import pickle
from itertools import product

import numpy as np
import pytest

from pipelines.serving.state import TreeWriter, read_tree
from saga_fg import Tracker
from saga_fg.tracking.clock import MANY_SENSORS, MAX_JUMP, Clock, weighted_median
from saga_fg.tracking.clock_offsets import MAX_SAMPLES, PairSamples
from tests.saga_fg.traffic_frames import columns, frame

MAX_DELAY, START = 0.5, 5.0
RATES = {"lidar": 10.0, "camera": 12.0}


def arrivals(rates, wrong, stamp, end=25.0, start=START):
    """(time, sensor, timestamp) in order of arrival; stamp(time, frame since the start of the fault)."""
    found = [
        (k / rate + 0.013 * n, name) for n, (name, rate) in enumerate(rates.items()) for k in range(int(end * rate))
    ]
    count = 0
    for time, name in sorted(found):
        shown = time
        if name == wrong and time >= start:
            shown, count = stamp(time, count), count + 1
        yield time, name, shown


def shares(rates, wrong, stamp, start=START):
    """Share of the frames of each right sensor that is used, and all verdicts."""
    clock, used, sent, verdicts = Clock(), dict.fromkeys(rates, 0), dict.fromkeys(rates, 0), []
    for time, name, shown in arrivals(rates, wrong, stamp, start=start):
        verdict, clock = clock.judged(shown, name, MAX_JUMP, MAX_DELAY)
        verdicts.append(verdict)
        sent[name] += time >= START
        used[name] += time >= START and verdict not in ("late", "unconfirmed")
    return {name: used[name] / sent[name] for name in rates if name != wrong}, verdicts


def jumping(time, count):
    return time + np.random.default_rng(int(time)).uniform(-10.0, 10.0)


FAULTS = {
    **{f"{size:+g}": (lambda t, k, size=size: t + size) for size in (0.1, -0.1, 1, -1, 8, -8, 3600, -3600, 0.45, 0.55)},
    **{f"{s} x{n}": (lambda t, k, s=s, n=n: t + s * (k < n)) for s in (8.0, 3600.0) for n in (1, 2)},
    "drift": lambda t, k: t + 1e-3 * (t - START),
    "jumps": jumping,
}


def test_majorities_and_steadiness_say_which_clock_is_right(subtests):
    for (name, fault), radar, wrong in product(FAULTS.items(), [5.0, 20.0], ["radar", "lidar"]):
        with subtests.test(name, radar=radar, wrong=wrong):
            used, verdicts = shares({**RATES, "radar": radar}, wrong, fault)
            assert min(used.values()) >= 0.99
            assert not {"set_ahead", "set_back"} & set(verdicts), "the tracks of the others would be deleted"
    # The clock is wrong from its first frame, which may be the first of all.
    for offset, wrong in product([1.0, -1.0, 8.0, 3600.0, -3600.0], ["radar", "lidar"]):
        with subtests.test(offset=offset, wrong=wrong):
            used, _ = shares({**RATES, "radar": 15.0}, wrong, lambda t, k, by=offset: t + by, start=0.0)
            assert min(used.values()) == 1.0
    for offset, rate in product([1.0, 8.0, -8.0, 3600.0], [5.0, 20.0]):
        with subtests.test(offset=offset, rate=rate):
            used, _ = shares({"lidar": 10.0, "radar": rate}, "radar", lambda t, k, by=offset: t + by)
            assert used["lidar"] >= 0.99


@pytest.mark.parametrize("jump", [3600.0, -3600.0])
def test_a_clock_that_all_sensors_share_may_be_set(jump):
    clock, left_out = Clock(), 0
    for time, name, _ in arrivals({**RATES, "radar": 15.0}, "", lambda t, k: t):
        verdict, clock = clock.judged(time + jump * (time >= START), name, MAX_JUMP, MAX_DELAY)
        left_out += verdict in ("late", "unconfirmed")
    assert clock.newest == pytest.approx(25.0 + jump, abs=0.1)
    assert left_out <= 6


def test_a_pause_of_all_sensors_costs_two_frames_at_most():
    clock, left_out = Clock(), 0
    for time, name, _ in arrivals({**RATES, "radar": 15.0}, "", lambda t, k: t):
        verdict, clock = clock.judged(time + 4.0 * (time >= START), name, MAX_JUMP, MAX_DELAY)
        left_out += verdict != "accepted"
    assert left_out <= 2


def test_a_burst_of_two_sensors_after_a_stall_sets_nothing():
    clock, verdicts, held = Clock(), [], []
    for time, name, _ in arrivals({**RATES, "radar": 15.0}, "", lambda t, k: t):
        if START < time < START + 2.0 and name != "radar":
            held.append((time, name))
            continue
        due, held = ([*held, (time, name)], []) if time >= START + 2.0 else ([(time, name)], held)
        for t, sensor in due:
            verdict, clock = clock.judged(t, sensor, MAX_JUMP, MAX_DELAY)
            verdicts.append(verdict)
    assert set(verdicts) <= {"accepted", "late"}
    assert verdicts[-20:] == ["accepted"] * 20


def test_frames_in_the_name_of_a_right_sensor_do_not_spoil_its_clock():
    clock, late = Clock(), 0
    for time, name, _ in arrivals({**RATES, "radar": 15.0}, "", lambda t, k: t):
        for shown in (time + 3600.0, time):
            verdict, clock = clock.judged(shown, name, MAX_JUMP, MAX_DELAY)
        late += verdict != "accepted"
    assert late <= 2
    assert clock.sensor("lidar").step == pytest.approx(0.1, rel=0.3)


def test_a_new_scene_keeps_the_records_and_forgets_the_time():
    clock = Clock()
    for time, name, _ in arrivals(RATES, "", lambda t, k: t):
        _, clock = clock.judged(time, name, MAX_JUMP, MAX_DELAY)
    anew = clock.begun_anew()
    assert anew.newest == -np.inf
    assert [r.record for r in anew.sensors] == [r.record for r in clock.sensors]
    assert all(r.time is None for r in anew.sensors)


def test_sensors_of_short_records_are_forgotten_first():
    clock = Clock()
    for k in range(500):
        _, clock = clock.judged(0.1 * k, "lidar", MAX_JUMP, MAX_DELAY)
        _, clock = clock.judged(0.1 * k, f"sensor {k}", MAX_JUMP, MAX_DELAY)
    assert len(clock.sensors) == MANY_SENSORS
    assert clock.sensor("lidar").kept == 500


def test_the_median_counts_weights():
    assert weighted_median([(0.0, 1.0), (5.0, 1.0), (0.1, 1.0)]) == 0.1
    assert weighted_median([(5.0, 3.0), (0.0, 1.0), (0.1, 1.0)]) == 5.0
    assert weighted_median([(5.0, 1.0), (0.1, 1.0)]) == 0.1


# offsets by objects in common


def circles(time, rng, number=10):
    """Positions (n, 2) of cars on circles, seen with a noise of 0.2 m."""
    draw = np.random.default_rng(1)
    centre, phase, rate = (
        draw.uniform(-100, 100, (number, 2)),
        draw.uniform(0, 6, number),
        draw.uniform(0.2, 0.5, number),
    )
    angle = phase + rate * time
    return centre + 20 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + 0.2 * rng.normal(size=(number, 2))


def tracked(wrong, offset, end=6.0, tracker=None, begin=0.0, sensors=("lidar", "camera", "radar")):
    tracker = tracker or Tracker()
    rates = {name: rate for name, rate in {**RATES, "radar": 15.0}.items() if name in sensors}
    used = []
    for time, name, shown in arrivals(rates, wrong, lambda t, k: t + offset, end, start=0.0):
        if time >= begin:
            rng = np.random.default_rng([3, round(1e4 * time)])
            tracker.step(frame(shown, circles(time, rng), name))
            used.append((time, name, tracker.time_verdict not in ("late", "unconfirmed")))
    return tracker, used


def test_a_steady_offset_is_found_and_corrected(subtests):
    for wrong, offset in [("radar", 0.05), ("lidar", -2.0), ("radar", 3600.0)]:
        with subtests.test(wrong=wrong, offset=offset):
            tracker, used = tracked(wrong, offset)
            clocks = tracker.sensor_times
            assert clocks[wrong].offset == pytest.approx(offset, abs=0.01)
            assert abs(clocks[wrong].offset - offset) <= 3 * clocks[wrong].deviation <= 0.02
            assert clocks[wrong].corrected == pytest.approx(offset, abs=0.015)
            assert [each.corrected for name, each in clocks.items() if name != wrong] == [0.0, 0.0]
            assert all(ok for time, name, ok in used if name == wrong and time > 4.0), "it is used again"
            assert len(tracker.tracks(6.0)) == 10, "one track for each object"


def test_of_two_sensors_the_one_heard_first_is_right():
    clocks = tracked("camera", 0.2, sensors=("lidar", "camera"))[0].sensor_times
    assert clocks["lidar"].offset == 0.0
    assert clocks["camera"].corrected == pytest.approx(0.2, abs=0.02)


def test_right_clocks_are_left_alone_and_a_single_one_is_not_compared():
    clocks = tracked("", 0.0)[0].sensor_times
    assert [each.corrected for each in clocks.values()] == [0.0] * 3
    assert max(abs(each.offset) for each in clocks.values()) < 0.02
    tracker = tracked("", 0.0, sensors=("lidar",))[0]
    assert tracker.snapshot().shared.seen == ()
    assert list(tracker.sensor_times) == ["lidar"]


def test_what_is_known_of_clocks_is_in_snapshots_and_state_files():
    first, _ = tracked("radar", 1.0, end=3.0)
    tree = TreeWriter(first.snapshot())
    restored = Tracker()
    restored.restore(read_tree(tree.nodes, bytes(tree.arrays)))
    twins = [first, restored, pickle.loads(pickle.dumps(first)), copy.deepcopy(first)]
    assert len({str(twin.sensor_times) for twin in twins}) == 1
    ends = [tracked("radar", 1.0, end=5.0, tracker=twin, begin=3.0)[0] for twin in twins]
    assert len({str(twin.sensor_times) for twin in ends}) == 1
    assert all(columns(twin.tracks(5.0)) == columns(first.tracks(5.0)) for twin in ends)


@pytest.mark.parametrize("drift", [0.0, 1e-2])
def test_the_offset_of_a_pair_is_that_of_the_densest_cluster(drift):
    rng, empty = np.random.default_rng(0), np.empty(0)
    pair = PairSamples("a", "b", empty, empty, empty)
    for k in range(120):
        time = 0.1 * k
        true, false = 0.3 + drift * time + 0.03 * rng.normal(size=3), rng.uniform(-2.5, 2.5, 1)
        pair = pair.added(time, np.concatenate([true, false]), np.full(4, 0.03**2))
    found = pair.estimate
    assert len(pair.offset) == MAX_SAMPLES
    assert found.steady
    assert found.offset == pytest.approx(0.3 + drift * 11.9, abs=4 * found.deviation)
    assert found.drift == pytest.approx(drift, abs=4 * found.drift_deviation)
