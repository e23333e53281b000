"""Covariances that come with detections: they take the place of the sensor's noise model, in any coordinates."""

import numpy as np
import pytest

from saga_fg import Boxes, Detection, Detections, Frame, InputError, Sensor, Tracker, TrackerSettings
from saga_fg.model.sensor import NoiseModel
from saga_fg.numerics.geometry import yaw_transform

SENSOR = Sensor(noise={"default": NoiseModel(position=0.3)})
ALONG = np.array([[[4.0, 0.0], [0.0, 0.01]]])  # wide along x


def table(covariance=None, places=((10.0, 0.0, 0.0),)):
    boxes = Boxes.of(["car"] * len(places), places)
    more = {} if covariance is None else {"position_covariance": covariance}
    return Detections(boxes, np.ones(len(places)), **more)


def test_a_reported_covariance_takes_the_place_of_the_model():
    both = Detections.concatenate([table(ALONG), table()])
    R = SENSOR.detection_covariance(both, None)[:, :2, :2]
    assert R[0] == pytest.approx(ALONG[0])
    assert R[1] == pytest.approx(0.09 * np.eye(2))


@pytest.mark.parametrize("estimator", ["kalman", "isam2", "fixed-lag"])
def test_a_new_track_is_as_uncertain_as_its_detection(estimator):
    tracker = Tracker(TrackerSettings(estimator=estimator), {"lidar": SENSOR})
    quarter = yaw_transform(0, 0, 0, np.pi / 2)
    tracks = tracker.step(Frame(0.0, "lidar", table(ALONG), quarter, "ego"))
    assert tracks.position_covariance[0] == pytest.approx(np.diag([0.01, 4.0]), abs=1e-6)


def test_covariances_survive_selection_and_single_detections():
    both = Detections.concatenate([table(), table(ALONG)])
    assert both.select([1]).position_covariance == pytest.approx(ALONG)
    one = both[1]
    assert one.position_covariance == (4.0, 0.0, 0.01)
    assert Detections.of([one, both[0]]).position_covariance[0] == pytest.approx(ALONG[0])


def test_wrong_covariances_are_refused(subtests):
    for covariance, message in [
        (-ALONG, "position_covariance.0.: expected a positive definite"),
        (np.array([[[1.0, 0.5], [0.0, 1.0]]]), "position_covariance.0.: expected a symmetric"),
        (np.ones((2, 2)), "position_covariance: expected shape"),
        (np.array([[[1.0, np.nan], [np.nan, 1.0]]]), "position_covariance.0, 0, 1.: expected a finite number"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            table(covariance)


def test_a_wrong_covariance_of_one_detection_is_refused():
    with pytest.raises(InputError, match="expected a positive definite"):
        Detection("car", (0, 0, 0), position_covariance=(1.0, 2.0, 1.0))
