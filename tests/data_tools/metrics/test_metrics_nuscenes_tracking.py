"""The metrics of nuScenes, by hand and beside the development kit."""

import math
import os
import sys
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from benchmarks.metrics import PYTHON_VARIABLE, differences, official_figures, parity, tracked_simulation
from data_tools.datasets.nuscenes.source import read_scored_scenes
from data_tools.metrics import (
    NuScenesClassMetrics,
    NuScenesTrackingMetrics,
    NuScenesTrackingScene,
    NuScenesTrackingSettings,
    SceneBoxes,
    nuscenes_tracking_metrics,
)
from saga_fg import Boxes, InputError
from tests.data_tools.nuscenes_random_drive import VERSION, write_random_drive


def table(rows):
    """SceneBoxes from (frame, id, label, x, y, score), in order of frame."""
    frame, names, label, x, y, score = zip(*rows, strict=True) if rows else ((),) * 6
    position = np.stack([x, y, np.zeros(len(x))], axis=1) if rows else np.empty((0, 3))
    return SceneBoxes(
        np.array(frame, dtype=np.int64), np.array(names, dtype=str), Boxes.of(label, position), np.array(score, float)
    )


def scene(truth, found, frames=None, **options):
    """A scene at 2 Hz with the vehicle in the origin."""
    n = frames or 1 + max(row[0] for row in (*truth, *found))
    return NuScenesTrackingScene(
        np.arange(n) * 0.5, np.zeros((n, 2)), table([(*row, 0.0)[:6] for row in truth]), table(found), **options
    )


def figures(truth, found, label="car", **options):
    return nuscenes_tracking_metrics([scene(truth, found, **options)]).per_class[label]


CAR = [(k, "a", "car", 10.0 + k, 0.0) for k in range(4)]


def test_gaps_of_truth_and_tracks_are_filled_with_the_official_weights():
    # Truth is unseen at frame 1, 1 / 4 of the way from x = 10 to x = 20; the official weights put it at 3 / 4.
    truth = [(0, "a", "car", 10.0, 0.0), (4, "a", "car", 20.0, 0.0)]
    found = [(1, "t", "car", 17.5, 0.0, 0.9)]
    f = figures(truth, found)
    assert (f.gt, f.tp) == (5, 1)
    assert f.motp == pytest.approx(0.0, abs=1e-6)
    found = [(0, "t", "car", 10.0, 0.0, 0.9), (3, "t", "car", 13.0, 0.0, 0.5)]
    f = figures(CAR, found)
    assert (f.tp, f.fn) == (4, 0)
    assert f.motp == pytest.approx(0.5)  # 12 for 11 and 11 for 12 inside, exact at the ends


def test_range_depends_on_the_class_and_is_measured_from_the_vehicle():
    truth = [(0, name, name, 45.0, 0.0) for name in ("car", "pedestrian")]
    metrics = nuscenes_tracking_metrics([scene(truth, [])])
    assert metrics.per_class["car"].gt == 1
    assert math.isnan(metrics.per_class["pedestrian"].gt)
    limit = NuScenesTrackingSettings(class_range={"car": 45.0})
    assert math.isnan(nuscenes_tracking_metrics([scene(truth, [])], limit).per_class["car"].gt)


def test_bicycles_in_a_rack_are_left_out_on_both_sides():
    rack = Boxes.of(["rack"], [(10, 0, 0)], [(4, 1, 2)], [math.pi / 2])
    truth = [(0, "in", "bicycle", 10.4, 1.9), (0, "out", "bicycle", 11.9, 0.0), (0, "car", "car", 10.0, 1.0)]
    found = [(0, "t", "bicycle", 10.4, -1.9, 0.9)]
    metrics = nuscenes_tracking_metrics([scene(truth, found, racks=[rack])])
    assert metrics.per_class["bicycle"].gt == 1
    assert metrics.per_class["bicycle"].recall == 0
    assert metrics.per_class["car"].gt == 1
    assert nuscenes_tracking_metrics([scene(truth, found)]).per_class["bicycle"].gt == 2


def test_a_class_that_is_never_matched_gets_the_worst_figures():
    f = figures(CAR, [(0, "t", "car", 30.0, 0.0, 0.9)])
    assert (f.amota, f.amotp, f.motp, f.recall, f.tp, f.fn, f.ml, f.faf, f.tid, f.lgd) == (
        0,
        2,
        2,
        0,
        0,
        4,
        1,
        500,
        20,
        20,
    )
    assert math.isnan(f.fp)
    assert math.isnan(f.ids)
    assert math.isnan(f.frag)


def test_classes_without_truth_do_not_count():
    metrics = nuscenes_tracking_metrics([scene(CAR, [(*row, 0.9) for row in CAR] + [(3, "b", "bus", 5.0, 5.0, 0.9)])])
    assert metrics.overall.amota == 1.0
    assert metrics.overall.fp == 0
    assert math.isnan(metrics.per_class["bus"].amota)
    assert set(metrics.curves) == {"car"}
    nothing = nuscenes_tracking_metrics([scene([], [], frames=2)]).overall
    assert math.isnan(nothing.amota)
    assert nothing.gt == 0


def test_bad_tables_and_scenes(subtests):
    for rows, text in [
        ([(1, "a", "car", 0, 0, 0), (0, "b", "car", 0, 0, 0)], "never decrease"),
        ([(0, "a", "car", 0, 0, 0), (1, "b", "car", 0, 0, 0), (1, "b", "car", 1, 0, 0)], r"id\[2\].*'b' occurs twice"),
    ]:
        with subtests.test(rows=rows, text=text), pytest.raises(InputError, match=text):
            table(rows)


def plain_match(truth, found, threshold):
    """CLEAR matching of one scene, one threshold, one class, object by object.

    truth and found: {frame: {id: (x, y)}}, found with scores: {frame: {id: (x, y, score)}}. Returns, per object, its
    events in order: None (missed) or (track, switched, distance); the scores of the plain matches; false alarms.
    """
    memory, events, scores, false_alarms = {}, {}, [], 0
    for k in sorted(set(truth) | set(found)):
        objects = truth.get(k, {})
        tracks = {i: v for i, v in found.get(k, {}).items() if v[2] >= threshold}
        pairs = {}
        for o, xy in objects.items():
            t = memory.get(o)
            if t in tracks and t not in pairs.values() and math.dist(xy, tracks[t][:2]) < 2.0:
                pairs[o] = t
        kept = set(pairs)
        left = [o for o in objects if o not in pairs]
        free = [t for t in tracks if t not in pairs.values()]
        cost = np.array([[math.dist(objects[o], tracks[t][:2]) for t in free] for o in left]).reshape(
            len(left), len(free)
        )
        for r, c in zip(*linear_sum_assignment(np.where(cost < 2.0, cost, 1e6)), strict=True):
            if cost[r, c] < 2.0:
                pairs[left[r]] = free[c]
        for o, xy in objects.items():
            if o not in pairs:
                events.setdefault(o, []).append(None)
                continue
            t = pairs[o]
            switched = o not in kept and o in memory
            events.setdefault(o, []).append((t, switched, math.dist(xy, tracks[t][:2])))
            if not switched:
                scores.append(tracks[t][2])
            memory[o] = t
        false_alarms += len(tracks) - len(pairs)
    return events, scores, false_alarms


def plain_figures(truth, found):
    """The figures of one class in one scene without gaps, by the definition, one threshold after the other."""
    gt = sum(map(len, truth.values()))
    _, scores, _ = plain_match(truth, found, -math.inf)
    scores = sorted(scores, reverse=True)
    reached = [(n + 1) / gt for n in range(len(scores))]
    rows = []
    for recall in np.linspace(0.1, 1, 40).round(12)[::-1]:
        if not scores or recall > reached[-1]:
            rows.append(None)
            continue
        threshold = float(np.interp(recall, reached, scores))
        events, _, fp = plain_match(truth, found, threshold)
        hits = [event for sequence in events.values() for event in sequence if event]
        ids = sum(switched for _, switched, _ in hits)
        tp, fn = len(hits) - ids, gt - len(hits)
        frag, delays, gaps, ratios = 0, [], [], []
        for sequence in events.values():
            shown = "".join("x" if event else "." for event in sequence)
            ratios.append(shown.count("x") / len(shown))
            frag += shown.strip(".").count("x.")
            if "x" in shown:
                delays.append(0.5 * shown.index("x"))
                gaps.append(0.5 * max(map(len, shown.split("x"))))
        present = {k for k, tracks in found.items() if any(v[2] >= threshold for v in tracks.values())}
        frames = len({k for k, objects in truth.items() if objects} | present)
        rows.append(
            {
                "recall": len(hits) / gt,
                "motar": max(0.0, 1 - (fn + ids + fp - (gt - tp)) / tp) if tp else math.nan,
                "gt": gt,
                "mota": max(0.0, 1 - (fn + ids + fp) / gt),
                "motp": sum(d for _, _, d in hits) / len(hits) if hits else math.nan,
                "mt": sum(r >= 0.8 for r in ratios),
                "ml": sum(r < 0.2 for r in ratios),
                "faf": 100 * fp / frames,
                "tp": tp,
                "fp": fp,
                "fn": fn,
                "ids": ids,
                "frag": frag,
                "tid": float(np.mean(delays)) if delays else math.nan,
                "lgd": float(np.mean(gaps)) if gaps else math.nan,
            }
        )
    run = [row for row in rows if row]
    if not run:
        return None
    best = max(run, key=lambda row: row["mota"])
    amota = np.mean([0.0 if row is None or math.isnan(row["motar"]) else row["motar"] for row in rows])
    amotp = np.mean([2.0 if row is None or math.isnan(row["motp"]) else row["motp"] for row in rows])
    return NuScenesClassMetrics(amota=float(amota), amotp=float(amotp), **best)


@given(st.integers(0, 2**32 - 1))
def test_equals_a_plain_reading_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    frames, objects, false = rng.integers(1, 9), rng.integers(1, 7), rng.integers(0, 4)
    start, speed = rng.uniform(-4, 4, (objects, 2)), rng.uniform(-1, 1, (objects, 2))
    score = rng.integers(0, 8, size=4 * objects + false) / 8  # few values: thresholds repeat; means are exact
    truth, found = {}, {}
    names = list(range(objects))
    for k in range(frames):
        truth[k] = {o: tuple(start[o] + k * speed[o]) for o in range(objects)}
        swap = rng.random(objects) < 0.2
        names = [n + objects if s and n + objects < 4 * objects else n for n, s in zip(names, swap, strict=True)]
        seen = {names[o]: tuple(truth[k][o] + rng.normal(0, 0.7, 2)) for o in range(objects)}
        seen |= {4 * objects + f: tuple(rng.uniform(-5, 5, 2)) for f in range(false)}
        found[k] = {t: (*xy, float(score[t])) for t, xy in seen.items()}
    expected = plain_figures(truth, found)
    f = figures(
        [(k, str(o), "car", *xy) for k, row in truth.items() for o, xy in row.items()],
        [(k, str(t), "car", *row) for k, tracks in found.items() for t, row in tracks.items()],
    )
    if expected is None:
        assert f.amota == 0
        assert f.amotp == 2
        return
    for field in fields(NuScenesClassMetrics):
        assert getattr(f, field.name) == pytest.approx(getattr(expected, field.name), abs=1e-6, nan_ok=True), field.name


def test_scenes_are_scored_together_and_identities_are_apart():
    # The same names in both scenes, by different tracks: no switch between scenes.
    first = scene(CAR, [(*row, 0.9) for row in CAR])
    second = scene(CAR, [(k, "other", *rest, 0.8) for k, _, *rest in CAR])
    metrics = nuscenes_tracking_metrics([first, second])
    assert metrics.overall.ids == 0
    assert metrics.overall.tp == 8
    assert metrics.overall.mt == 2


# Our nuScenes tracking metrics against the official ones, run by an interpreter of their own


@pytest.fixture(scope="session")
def devkit() -> str:
    python = os.environ.get(PYTHON_VARIABLE, "")
    if not python:
        pytest.skip(f"no official development kit: set {PYTHON_VARIABLE} to a python that has nuscenes-devkit")
    return python


def assert_equal(ours: NuScenesTrackingMetrics, theirs: dict[str, Any]) -> None:
    apart = {name: value for name, value in differences(ours, theirs) if value > 1e-6}
    assert not apart


def test_our_figures_are_those_of_the_kit(devkit, tmp_path):
    result = write_random_drive(tmp_path / "drive", seed=0)
    ours = nuscenes_tracking_metrics(
        [each.tracking for each in read_scored_scenes(result, tmp_path / "drive", VERSION).values()]
    )
    assert ours.overall.ids > 0
    assert math.isnan(ours.per_class["trailer"].amota)
    assert_equal(ours, official_figures(devkit, result, tmp_path / "drive", VERSION, "drive")[0])
    result = tracked_simulation(tmp_path / "simulated", scenes=1)
    outcome = parity(devkit, result, tmp_path / "simulated", VERSION, "all")
    assert outcome["AMOTA"] > 0.3
    assert outcome["largest difference"] <= 1e-6, outcome["where"]


def test_differences_and_kits_that_fail_are_found(tmp_path):
    ours = NuScenesTrackingMetrics(NuScenesClassMetrics(*np.arange(17.0)), per_class={}, curves={})
    names = [field.name for field in fields(NuScenesClassMetrics)]
    theirs = dict(zip(names, np.arange(17.0), strict=True)) | {"label_metrics": {name: {} for name in names}}
    assert max(value for _, value in differences(ours, theirs)) == 0
    assert dict(differences(ours, theirs | {"ids": 12.5}))["ids"] == 0.5
    assert dict(differences(ours, theirs | {"lgd": math.nan}))["lgd"] == math.inf
    with pytest.raises(InputError, match="expected a python that has nuscenes-devkit"):
        official_figures(str(tmp_path / "python"), tmp_path, tmp_path, VERSION, "all")
    with pytest.raises(InputError, match=r"the development kit failed: .*Error"):
        official_figures(sys.executable, tmp_path, tmp_path, VERSION, "all")
