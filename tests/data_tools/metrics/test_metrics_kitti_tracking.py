"""The metrics of KITTI, and HOTA."""

import functools
import json
import math
import operator
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.datasets.kitti.labels import read_kitti_labels
from data_tools.metrics import KittiTrackingSequence, SceneBoxes, hota_metrics, kitti_tracking_metrics
from data_tools.metrics.kitti_boxes import CameraBoxes, KittiObjects
from data_tools.metrics.kitti_tracking import track_scores, trajectory_counts
from saga_fg import Boxes, InputError, MissingExtraError

BOX = {"type": "Car", "z": 10.0, "score": math.nan, "truncated": 0, "occluded": 0, "bbox": (100, 100, 200, 200)}
LOW = {"bbox": (100, 100, 200, 120)}


def objects(*rows):
    """Rows (frame, id, x) or (frame, id, x, options as in BOX); boxes of 4 m along x, 2 m deep, 1.5 m high."""
    rows = [(*row, {})[:4] for row in rows]
    full = [BOX | options for *_, options in rows]
    n = len(rows)

    def column(name):
        return np.array([row[name] for row in full], dtype=float)

    return KittiObjects(
        frame=np.array([row[0] for row in rows], dtype=np.int64),
        track_id=np.array([row[1] for row in rows], dtype=np.int64),
        type=np.array([row["type"] for row in full], dtype=str),
        truncated=column("truncated"),
        occluded=column("occluded"),
        alpha=np.zeros(n),
        bbox=column("bbox").reshape(n, 4),
        boxes=CameraBoxes(
            np.tile([1.5, 2.0, 4.0], (n, 1)),
            np.array([(row[2], 1.7, options["z"]) for row, options in zip(rows, full, strict=True)]).reshape(n, 3),
            np.zeros(n),
        ),
        score=column("score"),
    )


def figures(truth, found, label="car", min_iou=0.25):
    return kitti_tracking_metrics([KittiTrackingSequence(objects(*truth), objects(*found))], label, min_iou)


CARS = [(f, n, 10.0 * n) for f in range(25) for n in range(4)]  # 100 boxes
PERFECT = [(*row, {"score": 1.0}) for row in CARS]


def test_counts_by_hand():
    # Object 0 found, shifted by 1 m (IoU 3 / 5); object 1 in 10 frames; object 2 by two tracks in turn; a false alarm.
    found = [(f, 0, 1.0, {"score": 1.0}) for f in range(25)]
    found += [(f, 1, 10.0, {"score": 1.0}) for f in range(10)]
    found += [(f, 2 if f < 13 else 3, 20.0, {"score": 1.0}) for f in range(25)]
    found += [(7, 9, 80.0, {"score": 1.0})]
    f = figures(CARS, found)
    assert (f.tp, f.fp, f.fn, f.ids, f.frag) == (60, 1, 40, 1, 1)
    assert f.mota == pytest.approx(1 - 42 / 100)
    assert f.motp == pytest.approx((25 * 0.6 + 35) / 60)
    assert (f.mt, f.ml) == (0.5, 0.25)
    strict = figures(CARS, found, min_iou=0.7)
    assert (strict.tp, strict.fp, strict.fn) == (35, 26, 65)


def test_neither_matched_boxes_nor_low_scores_spoil_a_threshold():
    # 50 true boxes score high, 50 low, 50 false alarms between: at low recall only the high ones are there.
    found = [(f, n, x, {"score": 1.0 if n < 2 else 0.25}) for f, n, x in CARS]
    found += [(f, 5 + n, 300.0 + 10 * n, {"score": 0.5}) for f in range(25) for n in range(2)]
    f = figures(CARS, found)
    assert (f.tp, f.fp, f.mota) == (50, 0, 0.5)  # as good as all with 50 false alarms; the first is kept
    low, high = 20, 20  # recalls up to a half are reached by the high scores
    assert f.amota == pytest.approx((low * 0.5 + high * 0.5) / 40)
    assert f.samota < 1.0
    # Above a score of 0.5 track 1 alone is at object 0 and matches it, low in the image as it is. With all tracks,
    # track 0 fits better, and track 1, left over, would be let pass.
    truth = [(f, n, 50.0 * n) for f in range(40) for n in range(2)]
    found = [(f, 0, 0.0, {"score": 0.5}) for f in range(40)] + [(f, 2, 50.0, {"score": 0.75}) for f in range(40)]
    found += [(f, 1, 1.0, {"score": 1.0} | LOW) for f in range(10)]
    f = figures(truth, found)
    assert (f.tp, f.fp) == (80, 10)


def test_boxes_that_need_not_be_found():
    truth = CARS + [(f, 10, 100.0, {"type": "Van"}) for f in range(25)]
    truth += [(f, 11, 110.0, {"truncated": 1}) for f in range(25)] + [
        (f, 12, 120.0, {"occluded": 3}) for f in range(25)
    ]
    truth += [(f, 13, 130.0, {"occluded": 2}) for f in range(25)] + [
        (f, 14, 140.0, {"type": "Truck"}) for f in range(25)
    ]
    f = figures(truth, PERFECT)
    assert (f.gt, f.fn) == (125, 25)
    found = PERFECT + [(f, 10 + n, 100.0 + 10 * n, {"score": 1.0}) for f in range(25) for n in range(5)]
    f = figures(truth, found)
    assert (f.gt, f.fn, f.fp) == (125, 0, 25)  # only what stands on the truck is false
    assert f.tp == 200
    assert f.mota == pytest.approx(1 - 25 / 125)


def test_boxes_that_need_not_match():
    region = [(f, -1, -1000.0, {"type": "DontCare", "bbox": (0, 0, 50, 50)}) for f in range(25)]
    extra = [(3, 20, 200.0, {"score": 1.0, "type": "Van"}), (3, 21, 210.0, {"score": 1.0} | LOW)]
    extra += [
        (3, 22, 220.0, {"score": 1.0, "bbox": (0, 0, 99, 50)}),
        (3, 23, 230.0, {"score": 1.0, "bbox": (0, 0, 101, 50)}),
    ]
    f = figures(CARS + region, PERFECT + extra)
    assert f.fp == 1  # the last one lies in the region for less than half


def test_rounding_costs_points_only_in_the_official_value():
    # The mean of 25 times 0.9 falls a bit short of 0.9, the mean of these means again: at every threshold all are gone.
    for score, official in ((0.5, 1.0), (0.9, 0.0)):
        f = figures(CARS, [(*row, {"score": score}) for row in CARS])
        assert f.samota == pytest.approx(official)
        assert f.samota_safe == pytest.approx(1.0)
        assert f.mota == f.mota_safe == f.recall == f.precision == f.mt == 1.0
        assert f.threshold_safe == pytest.approx(score)
    assert (f.gt, f.tp, f.fp, f.fn, f.ids, f.frag) == (100, 100, 0, 0, 0, 0)


def test_nothing_found_and_no_scores():
    f = figures(CARS, [])
    assert (f.tp, f.fp, f.fn, f.mota, f.samota, f.recall, f.precision, f.ml) == (0, 0, 100, 0.0, 0.0, 0.0, 0.0, 1.0)
    f = figures(CARS, CARS)
    assert f.samota == pytest.approx(1.0)


def test_sequences_are_counted_together_and_identities_are_apart():
    sequence = KittiTrackingSequence(objects(*CARS), objects(*PERFECT))
    other = KittiTrackingSequence(objects(*CARS), objects(*((f, n + 7, x, o) for f, n, x, o in PERFECT)))
    f = kitti_tracking_metrics([sequence, other], "car", 0.5)
    assert (f.gt, f.tp, f.ids) == (200, 200, 0)


def test_scores_keep_the_rounding_of_one_sum_after_the_other():
    def ten_times(x):
        return functools.reduce(operator.add, [x] * 10)  # not `sum`, which compensates rounding since Python 3.12

    value = 0.1
    once = ten_times(value) / 10
    assert once != value
    scores = track_scores(np.full(12, value), np.array([0] * 10 + [1] * 2), 3)
    twice = ten_times(once) / 10
    assert scores[0].tolist() == [once, twice, ten_times(twice) / 10]
    assert scores[11].tolist() == [value, value, value]


def plain_trajectory(track, exempt):
    """Switches, fragments, and whether mostly tracked, mostly lost, of one trajectory, frame by frame."""
    if all(exempt):
        return 0, 0, None
    if all(t < 0 for t in track):
        return 0, 0, "lost"
    switches = fragments = 0
    memory, tracked = track[0], int(track[0] >= 0)
    for k in range(1, len(track)):
        if exempt[k]:
            memory = -1
            continue
        known = memory >= 0 and track[k] >= 0
        switches += known and track[k - 1] >= 0 and memory != track[k]
        at_end = k == len(track) - 1
        fragments += track[k] != track[k - 1] and (track[k] >= 0 if at_end else known and track[k + 1] >= 0)
        if track[k] >= 0:
            memory = track[k]
            tracked += 1
    share = tracked / (len(exempt) - sum(exempt))
    return switches, fragments, "tracked" if share > 0.8 else "lost" if share < 0.2 else ""


trajectory = st.lists(st.tuples(st.integers(-1, 2), st.booleans()), min_size=1, max_size=9)


@given(st.lists(trajectory, min_size=1, max_size=4))
def test_trajectories_equal_a_plain_reading(trajectories):
    expected = [plain_trajectory(*map(list, zip(*rows, strict=True))) for rows in trajectories]
    track = np.array([t for rows in trajectories for t, _ in rows])[:, None]
    exempt = np.array([e for rows in trajectories for _, e in rows])
    identity = np.repeat(np.arange(len(trajectories)), [len(rows) for rows in trajectories])
    result = trajectory_counts(np.concatenate([track, np.full_like(track, -1)], axis=1), identity, exempt)
    assert result.switches.tolist() == [sum(s for s, _, _ in expected), 0]
    assert result.fragments.tolist() == [sum(f for _, f, _ in expected), 0]
    known = [state for _, _, state in expected if state is not None]
    assert result.mostly_tracked[0] == pytest.approx(known.count("tracked") / max(1, len(known)))
    assert result.mostly_lost[0] == pytest.approx(known.count("lost") / max(1, len(known)))


def test_agrees_with_the_reference_evaluation(recordings):
    golden = recordings / "golden" / "kitti_3dmot"
    if not golden.is_dir():
        pytest.skip(f"no reference figures at {golden}")
    sequences = [
        KittiTrackingSequence(
            read_kitti_labels(recordings / "kitti" / "training" / "label_02" / path.name), read_kitti_labels(path)
        )
        for path in sorted((golden / "results").glob("*.txt"))
    ]
    for label, by_iou in json.loads((golden / "expected.json").read_text()).items():
        for min_iou, expected in by_iou.items():
            f = kitti_tracking_metrics(sequences, label, float(min_iou))
            for name, value in expected.items():
                got = getattr(f, name.lower())
                if isinstance(value, float):
                    assert 100 * got == pytest.approx(value, abs=0.00501), (label, min_iou, name)
                else:
                    assert got == value, (label, min_iou, name)


# HOTA, CLEAR and Identity through trackeval: small cases worked out by hand


def table(rows, label="car"):
    """SceneBoxes from (frame, id, x); boxes of 4 x 2 x 1.5 m."""
    n = len(rows)
    return SceneBoxes(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=str),
        Boxes.of([label] * n, [(row[2], 0.0, 0.0) for row in rows], [(4.0, 2.0, 1.5)] * n, [0.0] * n),
        np.zeros(n),
    )


CAR = table([(k, "a", 5.0 * k) for k in range(10)])


def test_perfect_tracks_and_a_broken_one_by_hand():
    pytest.importorskip("trackeval")
    for similarity in ("centre", "bev_iou", "iou_3d"):
        f = hota_metrics([(CAR, CAR)], "car", similarity)
        assert (f.hota, f.deta, f.assa, f.loca, f.mota, f.idf1) == pytest.approx((1.0,) * 6)
        assert (f.fp, f.fn, f.ids, f.frag) == (0, 0, 0, 0)
    assert f.hota_at == pytest.approx(np.ones(19))
    assert f.alpha == pytest.approx(np.arange(0.05, 0.96, 0.05))
    pytest.importorskip("trackeval")
    # The object is followed by two tracks, each for half of the time: every pair has TPA 5, FNA 5, FPA 0.
    broken = table([(k, "t" if k < 5 else "u", 5.0 * k) for k in range(10)])
    f = hota_metrics([(CAR, broken)], "car")
    assert (f.deta, f.assa, f.hota) == pytest.approx((1.0, 0.5, np.sqrt(0.5)))
    assert (f.ids, f.mota) == (1, 0.9)
    assert (f.idf1, f.idp, f.idr) == pytest.approx((0.5, 0.5, 0.5))


def test_similarity_decides_from_which_alpha_on_a_pair_counts():
    pytest.importorskip("trackeval")
    shifted = table([(k, "t", 5.0 * k + 0.9) for k in range(10)])
    f = hota_metrics([(CAR, shifted)], "car", "centre", reach=4.0)
    assert f.loca < 1.0
    assert f.hota_at == pytest.approx((np.arange(0.05, 0.96, 0.05) < 0.775).astype(float))
    assert f.motp == pytest.approx(0.775)
    f = hota_metrics([(CAR, shifted)], "car", "iou_3d")
    assert f.motp == pytest.approx(3.1 / 4.9)
    assert hota_metrics([(CAR, shifted)], "car", "iou_3d", threshold=0.7).mota == pytest.approx(-1.0)


def test_scenes_are_put_together_and_classes_kept_apart():
    pytest.importorskip("trackeval")
    nothing = table([])
    other = table([(0, "x", 0.0)], "truck")
    f = hota_metrics([(CAR, CAR), (CAR, nothing), (nothing, other)], "car")
    assert (f.fn, f.fp) == (10, 0)
    assert f.deta == pytest.approx(0.5)
    assert f.assa == pytest.approx(1.0)
    assert f.idr == pytest.approx(0.5)


def test_what_hota_needs_is_named(monkeypatch):
    with pytest.raises(InputError, match="similarity: expected one of centre, bev_iou, iou_3d"):
        hota_metrics([(CAR, CAR)], "car", "giou")
    with pytest.raises(InputError, match="at least one scene"):
        hota_metrics([], "car")
    monkeypatch.setitem(sys.modules, "trackeval", None)
    with pytest.raises(MissingExtraError, match=r"saga-fg\[eval\]"):
        hota_metrics([(CAR, CAR)], "car")
