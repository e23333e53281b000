"""Recordings of landmarks, and maps of them."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import landmarks as module
from benchmarks.landmarks import START, TREE, TreeMapper, duplicates, pairwise_agreement
from benchmarks.recordings.landmarks import read_landmark_log
from saga_fg import InputError
from saga_fg.slam.mapping import LocalMap
from saga_fg.types.frame import Observation

R = 0.05**2 * np.eye(2)


def rounds(poses: int, rounds: float, radius: float) -> tuple[np.ndarray, float, float]:
    """Poses (N, 3) = x, y, heading on a circle, the length of a step and the turn of one."""
    turn = 2 * np.pi * rounds / poses
    angle = turn * np.arange(poses)
    return np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), angle], axis=1), radius * turn, turn


def park(folder: Path, seed: int = 0) -> tuple[Path, int]:
    """A drive in the format of Victoria Park, with odometry that is worse than it says; how many trees are seen."""
    rng = np.random.default_rng(seed)
    poses, step, turn = rounds(240, 2.2, 15.0)
    angle = np.linspace(0, 2 * np.pi, 17)[:-1]
    trees = np.stack([22 * np.sin(angle), 15 - 22 * np.cos(angle)], axis=1) + rng.uniform(-1.5, 1.5, (16, 2))
    lines, seen = [], set()
    for k, (x, y, heading) in enumerate(poses):
        if k:
            slip = np.array([step, 0.0, turn + 0.002 * np.sin(k / 20)])  # which persists for a while
            dx, dy, dh = slip + rng.normal(0, [0.02, 0.005, 0.004])
            lines.append(f"ODOMETRY {1000 + k - 1} {1000 + k} {dx} {dy} {dh} 4e-4 0 0 2.5e-5 0 4e-6")
        c, s = np.cos(heading), np.sin(heading)
        local = (trees - [x, y]) @ np.array([[c, -s], [s, c]])
        for tree in np.flatnonzero((np.linalg.norm(local, axis=1) < 12) & (local[:, 0] > 0)):
            seen.add(int(tree))
            zx, zy = local[tree] + rng.normal(0, 0.1, 2)
            lines.append(f"LANDMARK {1000 + k} {tree} {zx} {zy} 0.01 0 0.01")
    path = folder / "park.txt"
    path.write_text("\n".join(lines) + "\n")
    return path, len(seen)


def test_trees_are_told_apart_without_their_names(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "SCALES", (1.0, 16.0, 256.0))
    path, trees = park(tmp_path)
    evidence, found = bench(f"landmarks {path}")
    assert found["pairwise F1"] > 0.95
    assert abs(found["trees"] - trees) <= 1
    tried = {float(scale): value for scale, value in evidence.items() if scale != "table"}
    assert found["odometry scale"] == max(tried, key=lambda scale: tried[scale]) < 256


def test_duplicates_are_merged_along_the_whole_drive_that_led_to_them(monkeypatch):
    """Round a block with a drift that odometry tells, past the first trees again before the loop is found."""
    monkeypatch.setattr(module, "SMOOTH_EVERY", 60)
    rng, mapper = np.random.default_rng(0), TreeMapper()
    angle = 2 * np.pi * np.arange(24) / 24
    trees = np.stack([36 * np.sin(angle), 30 - 36 * np.cos(angle)], axis=1) + rng.uniform(-1.5, 1.5, (24, 2))
    pose, step, sigma, true = gtsam.Pose2(), gtsam.Pose2(np.pi, 0.0, np.pi / 30), np.array([0.1, 0.1, 0.03]), []
    for _ in range(84):
        local = np.array([pose.transformTo(tree) for tree in trees])
        rows = np.flatnonzero((np.hypot(*local.T) < 18) & (local[:, 0] > 0))
        mapper.observe([Observation(TREE, local[row] + rng.normal(0, 0.05, 2), R) for row in rows])
        true += rows.tolist()
        mapper.move(step.retract(sigma * rng.normal(size=3)).matrix(), np.diag(sigma**2))
        pose = pose.compose(step)
    mapper.smooth()
    assert len(set(zip(mapper.numbers(), true, strict=True))) == len(mapper.local.kinds) == len(set(true)) == 24
    assert mapper.begun > 24


def test_the_filter_is_the_smoother_where_everything_is_linear():
    """A straight drive past points, without turns: joint filter and global solution agree."""
    rng, mapper = np.random.default_rng(0), TreeMapper()
    trees = np.array([[3.0, 4.0], [8.0, -5.0], [15.0, 3.0]])
    for k in range(8):
        seen = trees - [k, 0] + 0.05 * rng.normal(size=trees.shape)
        mapper.observe([Observation(TREE, z, 0.01 * np.eye(2)) for z in seen])
        mapper.move(gtsam.Pose2(1.0, 0.0, 0.0).matrix(), np.diag([1e-3, 1e-3, 1e-12]))
    filtered = mapper.local
    mapper.smooth()
    for number in (1, 2, 3):
        np.testing.assert_allclose(mapper.local.state(number), filtered.state(number), atol=1e-4)
    np.testing.assert_allclose(mapper.local.covariance([1, 2, 3]), filtered.covariance([1, 2, 3]), rtol=1e-2, atol=1e-6)


def revisited(shift: tuple[float, float], drift: float, count: int) -> LocalMap:
    """Trees 1 ... count, and begun anew after a drift of unknown direction, `shift` in truth."""
    places = np.array([[5.0, 5.0], [12.0, -4.0], [20.0, 6.0], [26.0, -7.0]])[:count]
    local = LocalMap(np.eye(3), START)
    for number, place in enumerate(places, start=1):
        local.augment(number, Observation(TREE, place, 0.01 * np.eye(2)))
    local.predict(np.eye(3), np.diag([drift**2, drift**2, 1e-8]))
    for number, place in enumerate(places + shift, start=count + 1):
        local.augment(number, Observation(TREE, place, 0.01 * np.eye(2)))
    return local


def test_constellations_are_recognised_and_what_was_seen_side_by_side_is_never_one():
    assert duplicates(revisited((4.0, 3.0), 5.0, 1), set()) == {}
    assert duplicates(revisited((4.0, 3.0), 5.0, 4), set()) == {5: 1, 6: 2, 7: 3, 8: 4}
    local = revisited((0.1, 0.0), 0.2, 2)
    assert duplicates(local, set()) == {3: 1, 4: 2}
    assert duplicates(local, {(1, 3)}) == {4: 2}


def beacons(folder: Path) -> Path:
    """A drive in the format of Plaza, whose radio measures 7 % and 0.3 m too much."""
    rng = np.random.default_rng(3)
    poses, *_ = rounds(400, 2.3, 20.0)
    poses[:, :2] += np.stack([6 * np.sin(np.arange(400) / 25), np.zeros(400)], axis=1)
    moved = np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2])
    heading = np.unwrap(np.arctan2(*np.diff(poses[:, :2], axis=0, append=poses[-1:, :2] + moved[-1:]).T[::-1]))
    along = np.linalg.norm(moved, axis=1)
    turned = np.diff(heading, prepend=heading[:1])
    places = {1: (30.0, 5.0), 4: (-25.0, 40.0), 6: (5.0, 20.0)}
    (folder / "B_DR.txt").write_text(
        "\n".join(
            f"{k / 5} {d * (1 + rng.normal(0, 0.02))} {a + rng.normal(0, 0.004)}"
            for k, (d, a) in enumerate(zip(along, turned, strict=True))
        )
    )
    lines = []
    for k in range(0, 400, 2):
        number = [1, 4, 6][k // 2 % 3]
        distance = np.hypot(*(places[number] - poses[k, :2]))
        echo = 8.0 if rng.random() < 0.05 else 0.0
        lines.append(f"{k / 5} 2 {number} {1.07 * distance + 0.3 + rng.normal(0, 0.2) + echo}")
    (folder / "B_TD.txt").write_text("\n".join(lines))
    (folder / "B_GT.txt").write_text("\n".join(f"{k / 5} {x} {y} 0" for k, (x, y, _) in enumerate(poses)))
    (folder / "B_TL.txt").write_text("\n".join(f"{n} {x} {y}" for n, (x, y) in places.items()))
    return folder / "B_DR.txt"


def test_beacons_are_found_by_ranges_alone(bench, tmp_path):
    (figures,) = bench(f"landmarks {beacons(tmp_path)}")
    assert figures["ATE, m"] < 0.5
    assert figures["ATE, m"] < 0.5 * figures["ATE of dead reckoning, m"]
    assert figures["beacons, m"] < 0.5
    assert figures["scale"] == pytest.approx(0.07, abs=0.02)


def test_a_scale_that_is_none_is_refused(refused, tmp_path):
    path, _ = park(tmp_path)
    assert "--odometry-scale 0: expected a number > 0" in refused(f"landmarks {path} --odometry-scale 0")


# Victoria Park and Plaza: what the files say, and what is said of broken ones

PARK = """\
ODOMETRY 0 1 1.5 0 0 0.01 0 0 0.02 0 0.03
ODOMETRY 1 3 0.5 0.25 1.5707963267948966 0.01 0.001 0 0.02 0 0.03
LANDMARK 1 2 4 -1 0.4 0.1 0.5
LANDMARK 3 2 5 6 0.4 0 0.4
"""
PLAZA = {
    "DR": "10.0 0.5 0.1\n10.2\t0.25\t-0.1\t\n",
    "TD": "10.15 2 3 12\n10.1 2 7 30.5\n",
    "GT": "10 1 2 0.5\n10.2 3 4 0.6\n",
    "TL": "7 20 30\n3 -1 -2\n",
}


def recorded_park(folder: Path, text: str) -> Path:
    path = folder / "park.txt"
    path.write_text(text)
    return path


def plaza(folder: Path, **texts: str) -> Path:
    for kind, text in (PLAZA | texts).items():
        (folder / f"P_{kind}.txt").write_text(text)
    return folder / "P_DR.txt"


def test_a_drive_past_trees_is_read(tmp_path):
    drive = read_landmark_log(recorded_park(tmp_path, PARK))
    np.testing.assert_allclose(drive.a_T_b[1], [[0, -1, 0.5], [1, 0, 0.25], [0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(drive.odometry_covariance[1], [[0.01, 0.001, 0], [0.001, 0.02, 0], [0, 0, 0.03]])
    assert drive.pose.tolist() == [1, 2]
    assert drive.landmark.tolist() == [2, 2]
    np.testing.assert_array_equal(drive.value, [[4, -1], [5, 6]])
    np.testing.assert_array_equal(drive.covariance[0], [[0.4, 0.1], [0.1, 0.5]])


def test_a_broken_drive_is_located(tmp_path, subtests):
    for old, new, message in [
        ("LANDMARK 1", "TREE 1", "line 3: expected ODOMETRY or LANDMARK, got 'TREE'"),
        ("0.02 0 0.03\nODO", "0.02 0\nODO", "line 1: expected 11 values after ODOMETRY, got 10"),
        ("1 3 0.5", "2 3 0.5", "line 2: i: expected pose 1, where the row before ended, got 2"),
        ("1 3 0.5", "1 0 0.5", "every pose once"),
        ("LANDMARK 3", "LANDMARK 4", "line 4: i: there is no pose 4"),
        ("4 -1 0.4", "inf -1 0.4", "line 3: x: expected a finite number, got 'inf'"),
        ("0.4 0.1 0.5", "0.4 0.9 0.5", "line 3: P11 ... P22: expected a positive definite"),
        (PARK, PARK.splitlines()[0], "expected LANDMARK records"),
    ]:
        with subtests.test(message):
            path = recorded_park(tmp_path, PARK.replace(old, new, 1))
            with pytest.raises(InputError, match=message) as caught:
                read_landmark_log(path)
            assert str(path) in str(caught.value)


def test_ranges_to_beacons_are_read(tmp_path):
    plaza(tmp_path)
    drive = read_landmark_log(tmp_path / "P_TL.txt")
    np.testing.assert_array_equal(drive.time, [10.0, 10.2])
    np.testing.assert_allclose(np.arctan2(drive.a_T_b[:, 1, 0], drive.a_T_b[:, 0, 0]), [-0.1])
    np.testing.assert_allclose(np.hypot(*drive.a_T_b[0, :2, 2]), 0.25)
    assert drive.pose.tolist() == [1, 1]
    assert drive.landmark.tolist() == [7, 3]
    np.testing.assert_array_equal(drive.value[:, 0], [30.5, 12.0])
    np.testing.assert_allclose(drive.truth.positions[1], [3, 4, 0])
    assert {k: v.tolist() for k, v in drive.places.items()} == {7: [20, 30], 3: [-1, -2]}


def test_broken_ranges_are_located(tmp_path, subtests):
    for texts, message in [
        ({"TD": "10.1 2 7 -3\n"}, "P_TD.txt: line 1: range: expected a number > 0"),
        ({"TD": "10.1 2 7.5 3\n"}, "P_TD.txt: line 1: beacon: expected a whole number"),
        ({"TD": "10.1 2 7\n"}, "P_TD.txt: line 1: expected 4 columns"),
        ({"TD": ""}, "P_TD.txt: expected records"),
        ({"DR": "10 1 0\n9 1 0\n"}, "P_DR.txt: line 2: time: expected 10.000000 or later"),
        ({"DR": "10 one 0\n"}, "P_DR.txt: line 1: distance: expected a finite number, got 'one'"),
        ({"TL": "1e300 20 30\n"}, "P_TL.txt: line 1: beacon: expected a number within"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            read_landmark_log(plaza(tmp_path, **texts))


# Pairwise agreement of two groupings

GROUPS = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=20)


def test_an_example_by_hand():
    found = pairwise_agreement([1, 1, 1, 2, 2], [7, 7, 8, 8, 8])
    assert found.precision == pytest.approx(2 / 4)
    assert found.recall == pytest.approx(2 / 4)
    assert pairwise_agreement([1, 2, 3], [1, 1, 1]).recall == 0
    assert pairwise_agreement([], []).F1 == 1


@given(GROUPS)
def test_it_counts_pairs(groups):
    a, b = (np.array([group[side] for group in groups], dtype=np.int64) for side in (0, 1))
    upper = np.triu_indices(len(a), 1)
    one, other = (a[:, None] == a)[upper], (b[:, None] == b)[upper]
    found = pairwise_agreement(a, b)
    assert found.precision == pytest.approx((one & other).sum() / one.sum() if one.any() else 1)
    assert found.recall == pytest.approx((one & other).sum() / other.sum() if other.any() else 1)
    assert pairwise_agreement(a, a + 100).F1 == 1
