"""Doubt about labels: probabilities, and the list of objects by what a look at them is worth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import Boxes, Detections, Frame, Tracker, TrackerSettings
from saga_fg.smoothing import LabelBuilder, LabelModel, RecordingLabels
from saga_fg.smoothing.doubt import HANDED_OUT, LEAST_GAIN, REASONS, far_off, gain_parts, object_probabilities
from saga_fg.smoothing.states import Probabilities


def drive(swap: bool = False) -> list[Frame]:
    """A car that drives and one that follows 30 m behind, both sure; something weak that is there twice; `swap`: two
    pedestrians that pass each other closely."""
    rng = np.random.default_rng(1)
    frames = []
    for k in range(40):
        t = 0.25 * k
        cars = [(8 * t, 0.0), (8 * t - 30, 0.0)]
        people = [(20.0 + t, 30.0), (30.0 - t, 30.4)] if swap else [(50.0, 40.0)]
        weak = [(10.0, -20.0)] if k in (5, 7) else []
        places = np.array([*cars, *people, *weak])
        n, boxes = len(places), np.zeros((len(places), 3))
        boxes[:, :2] = places + rng.normal(0, 0.1, (n, 2))
        label = ["car"] * 2 + ["pedestrian"] * len(people) + ["car"] * len(weak)
        score = np.array([0.9] * (2 + len(people)) + [0.2] * len(weak))
        size = np.tile([4.5, 1.9, 1.6], (n, 1))
        frames.append(
            Frame(t, "lidar", Detections(Boxes.of(label, boxes, size, np.zeros(n), np.full((n, 2), np.nan)), score))
        )
    return frames


def labelled(frames: list[Frame]) -> RecordingLabels:
    settings = TrackerSettings(min_hits=2)
    builder = LabelBuilder(Tracker(settings), LabelModel(settings))
    builder.add(frames, np.array([frame.timestamp for frame in frames]))
    return builder.finish()[0]


def test_every_label_has_probabilities_and_the_list_is_in_order():
    labels = labelled(drive())
    review = labels.review(0.0)
    assert (np.diff(review.gain) <= 0).all()
    assert (review.gain >= 0).all()
    boxes = dict(zip(review.id.tolist(), review.boxes.tolist(), strict=True))
    moments = [moment for part in labels for moment in part]
    ids = np.concatenate([moment.tracks.id for moment in moments])
    assert {id_: int((ids == id_).sum()) for id_ in boxes} == boxes
    for moment in moments:
        for column in moment.probability.table_columns().values():
            assert ((column >= 0) & (column <= 1)).all()
    for k, id_ in enumerate(review.id.tolist()):  # the place to look at is a label of the object
        (at,) = [moment for moment in moments if moment.tracks.timestamp == review.time[k]]
        np.testing.assert_allclose(at.tracks.boxes.position[at.tracks.id == id_][0, :2], review.position[k])


def test_what_little_speaks_for_is_in_doubt():
    review = labelled(drive()).review(0.0)
    exists = dict(zip(review.boxes.tolist(), review.probability.exists.tolist(), strict=False))
    weak = review.probability.exists[review.boxes <= 3]
    assert len(weak) == 1
    assert weak[0] < HANDED_OUT < min(p for n, p in exists.items() if n > 3)


def test_objects_that_meet_may_be_exchanged():
    far, near = labelled(drive()).review(0.0), labelled(drive(swap=True)).review(0.0)
    alone = far.probability.one[far.label == "pedestrian"]
    meeting = near.probability.one[near.label == "pedestrian"]
    assert meeting.max() < alone.min()
    first = near.time[(near.label == "pedestrian") & (near.why == "identity")]
    assert (np.abs(first - 5.0) < 2.0).all()  # when they pass each other


unit = st.floats(0, 1)


@given(st.lists(st.tuples(unit, unit, unit, unit, st.integers(1, 50), unit), min_size=1, max_size=8))
def test_gains_fall_with_certainty(rows):
    exists, label, one, heading, n, share = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    boxes, sure = n.astype(int), np.ones(len(n))
    parts = gain_parts(Probabilities(exists, label, one, heading), boxes, boxes, share * n)
    assert (parts >= 0).all()
    assert not gain_parts(Probabilities(sure, sure, sure, sure), boxes, boxes, 0 * n).any()
    kept = exists >= HANDED_OUT
    better = gain_parts(Probabilities(exists, sure, sure, sure), boxes, boxes, 0 * n)
    assert (better.sum(axis=1) <= parts.sum(axis=1) + 1e-12)[kept].all()
    missing, false = parts[:, REASONS == "missing"], parts[:, REASONS == "false"]
    assert not missing[kept].any()  # what is handed out may be false, what is held back may be missing
    assert not false[~kept].any()
    headless = gain_parts(Probabilities(exists, label, one, heading), boxes, 0 * boxes, share * n)
    assert not headless[:, REASONS == "heading"].any()


@pytest.mark.parametrize("name", ["score", "path", "votes"])
def test_more_evidence_is_more_certain(name):
    given_ = {"score": 0.3, "detections": 9.0, "weight": 5.0, "rivals": 0.0, "path": 2.0, "votes": 1.0, "one": 1.0}
    columns = {key: np.full(3, value) for key, value in given_.items()}
    columns[name] = columns[name] * np.array([0.5, 1.0, 2.0])
    found = object_probabilities(**columns)
    certain = found.exists if name == "score" else found.heading
    assert (np.diff(certain) > 0).all()


def boxes_far_off(count: int = 5, **columns: object) -> np.ndarray:
    usual = {"yaw_variance": 0.01, "speed": 0.0, "length": 0.5, "score": 0.5, "agreement": 0.9}
    P = np.asarray(columns.pop("variance", 0.01)) * np.ones(count)
    given_ = {name: np.asarray(columns.get(name, value)) * np.ones(count) for name, value in usual.items()}
    return far_off(P[:, None, None] * np.eye(2), **given_)


def test_what_is_well_determined_is_not_far_off():
    surer = 10.0 ** -np.arange(5)
    for length in (0.5, 12.0):
        settled = boxes_far_off(length=length, variance=surer, yaw_variance=surer, agreement=1 - 0.2 * surer)
        assert (np.diff(settled) < 0).all()
        assert settled[-1] < 1e-6
    assert (np.diff(boxes_far_off(agreement=1 - 0.2 * surer)) <= 0).all()
    assert boxes_far_off(agreement=0.8)[0] > 0.1  # headings that do not agree leave a small variance in doubt
    headless = boxes_far_off(yaw_variance=np.nan, agreement=0.0, variance=1e-3)
    assert (headless < 1e-6).all()


def test_standing_objects_that_detections_settle_are_not_listed_as_far_off():
    frames, rng = [], np.random.default_rng(0)
    for k in range(40):
        boxes = np.array([[10.0 * i, 5.0, 0.5] for i in range(4)])
        boxes[:, :2] += rng.normal(0, 0.03, (4, 2))
        yaw, size = 0.3 + rng.normal(0, 0.02, 4), np.tile([0.5, 2.5, 1.0], (4, 1))
        shown = Boxes.of(["barrier"] * 4, boxes, size, yaw, np.full((4, 2), np.nan))
        frames.append(Frame(0.5 * k, "lidar", Detections(shown, np.full(4, 0.9))))
    review = labelled(frames).review(0.0)
    assert len(review) == 4
    assert (review.far_off < 0.2).all()  # of 40 boxes


def test_what_gains_nothing_is_left_out_and_the_rest_stays():
    labels = labelled(drive())
    whole, listed = labels.review(0.0), labels.review()
    worth = whole.gain >= LEAST_GAIN
    assert listed.id.tolist() == whole.id[worth].tolist()
    assert worth.sum() > 0
    columns = listed.table_columns()
    np.testing.assert_allclose(columns["gain"], listed.gain, atol=5e-4)
    assert all(len(repr(value)) < 12 for name in ("gain", "boxes_far_off", "x") for value in columns[name].tolist())
