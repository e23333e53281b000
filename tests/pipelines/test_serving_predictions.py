"""Predictions of a stream: with every frame, and on request."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipelines.config import load_config
from pipelines.serving import StreamSettings, StreamTracker
from pipelines.serving.messages import encode
from saga_fg.tracking import Tracker
from tests.pipelines.test_serving import answers, frame


def stream(method: Any = "saga", horizons: Any = None, **settings: Any) -> StreamTracker[str]:
    config = load_config("file")
    return StreamTracker(lambda: config.new_tracker(method), StreamSettings(**settings), horizons=horizons)


def predict(horizons: Any) -> bytes:
    return encode({"type": "predict", "horizons": horizons})


def test_a_request_is_answered_with_the_trackers_predictions():
    service = stream()
    answers(service, *(frame(0.1 * k) for k in range(10)))
    (answer,) = answers(service, predict([0.5, 2]))
    assert answer["type"] == "predictions"
    assert answer["timestamp"] == pytest.approx(0.9)
    assert answer["horizons"] == [0.5, 2.0]
    (car,) = answer["tracks"]
    assert (car["id"], car["label"]) == (1, "car")
    tracker = service._tracker
    assert isinstance(tracker, Tracker)
    expected = tracker.predict([0.5, 2])
    np.testing.assert_allclose([car["x"], car["y"]], expected.position[:, 0].T)
    np.testing.assert_allclose([car["vx"], car["vy"]], expected.velocity[:, 0].T)
    np.testing.assert_allclose(car["cov_xy"], expected.position_covariance[:, 0, 0, 1])
    assert car["cov_xx"][0] < car["cov_xx"][1]
    assert "yaw" not in car or len(car["yaw"]) == 2


def test_a_request_changes_nothing():
    plain, asked = stream(), stream()
    expected = answers(plain, *(frame(0.1 * k) for k in range(6)))
    found = answers(asked, *(line for k in range(6) for line in (frame(0.1 * k), predict([3]))))
    assert found[::2] == expected


def test_every_frame_has_predictions_where_horizons_are_given():
    horizons = np.array([1.0, 3.0])
    for answer in answers(stream(horizons=horizons), *(frame(0.1 * k) for k in range(3))):
        assert answer["type"] == "tracks"
        predicted = answer["predictions"]
        assert predicted["timestamp"] == answer["timestamp"]
        assert predicted["horizons"] == [1.0, 3.0]
        assert [each["id"] for each in predicted["tracks"]] == [each["id"] for each in answer["tracks"]]


BAD_HORIZONS = [
    (None, "horizons: expected a list of at most 20 s, it is left out"),
    ([0.1] * 21, "horizons: expected a list of at most 20 s"),
    (["1"], "horizons: expected a finite number, got '1'"),
    ([], "horizons: expected increasing seconds"),
    ([2, 1], "horizons: expected increasing seconds"),
    ([1, 11], "horizons: expected at most 10 s, got 11"),
]


def test_other_horizons_are_refused():
    service = stream()
    answers(service, frame(0.0))
    for given, why in BAD_HORIZONS:
        (answer,) = answers(service, predict(given))
        assert answer["type"] == "error"
        assert why in answer["message"]


def test_there_is_nothing_to_predict_from_before_a_frame_or_by_centerpoint():
    (early,) = answers(stream(), predict([1]))
    assert "expected a frame before" in early["message"]
    (never,) = answers(stream("centerpoint"), predict([1]))
    assert "expected --method saga or kf" in never["message"]
