"""Hidden objects are predicted by the tracker's own step."""

import dataclasses

import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.learning import HiddenObjects, hidden_objects
from saga_fg.learning.hidden_objects import STEP
from saga_fg.model.edge_rules import Following, Neighbours, Repulsion
from saga_fg.model.interactions import SharedVelocity
from saga_fg.model.modes import Mixture
from saga_fg.model.motion import ConstantVelocity, Curvilinear
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.tracking import ClassSettings, Tracker, TrackerSettings
from tests.saga_fg.following_pairs import GAP, following_pairs, scene_of

SENSORS = {"default": Sensor(noise={"default": NoiseModel(position=0.02, yaw=0.02)})}
ONCE = 1.5  # s
FOLLOW = Following(SharedVelocity(), rate=0.5, gap_scale=20.0)


def settings_of(motion):
    classes = {"default": ClassSettings(motion=motion, initial_speed_deviation=8.0, max_distance=20.0)}
    return TrackerSettings(classes=classes, edges=(), stationary_share=0.2)


VELOCITY = settings_of(ConstantVelocity(1.0))
FADING = settings_of(Curvilinear(fading_time=1.0, turn_time=2.0))


def turning(moments=60):
    """Three cars on a circle, which are seen to turn."""
    t = 0.1 * np.arange(moments)[:, None]
    angle = t * 0.3 + 0.4 * np.arange(3)
    position = np.stack([30 * np.sin(angle), -30 * np.cos(angle), 0 * angle], axis=-1)
    scene = scene_of(position)
    frames, truth = [], []
    for k, frame in enumerate(scene.frames):
        boxes = dataclasses.replace(frame.detections.boxes, yaw=angle[k])
        frames.append(dataclasses.replace(frame, detections=dataclasses.replace(frame.detections, boxes=boxes)))
        truth.append(dataclasses.replace(scene.ground_truth[k], boxes=boxes))
    return dataclasses.replace(scene, frames=frames, ground_truth=truth)


GAINED = (dataclasses.replace(FOLLOW, information_gain=True), Neighbours(rate=0.4))


@pytest.mark.parametrize(
    ("scene", "settings", "rules"),
    [
        (following_pairs(pairs=2, moments=60), VELOCITY, (FOLLOW,)),
        (following_pairs(pairs=2, moments=60), FADING, GAINED),
        (turning(), FADING, ()),
        (turning(), VELOCITY, GAINED),
    ],
    ids=["following", "by information gain", "turning alone", "turning by gain"],
)
def test_the_first_step_is_that_of_a_tracker_with_the_same_settings_and_rules(scene, settings, rules):
    sample = hidden_objects(scene, settings, SENSORS, ONCE)
    found = sample.predict(settings, rules)
    kf = Tracker(settings, SENSORS)
    compared = 0
    for frame in scene.frames:
        kf.step(frame)
        tracker = Tracker(settings, SENSORS, rules)
        tracker.restore(kf.snapshot())
        later = tracker.tracks(frame.timestamp + STEP)
        present = tracker.tracks(frame.timestamp)
        for w in range(len(sample)):
            start = sample.recorded.tracks.mean[sample.start[w], :2]
            row = np.flatnonzero(np.hypot(*(present.boxes.position[:, :2] - start).T) < 1e-9)
            if len(row) and np.isfinite(found.position[w, 0, 0]):
                then = later.boxes.position[later.id == present.id[row[0]], :2]
                np.testing.assert_allclose(found.position[w, :1], then, atol=1e-6)
                compared += 1
    assert compared >= 4


def test_a_gap_knows_its_neighbours_and_where_the_object_reappears():
    scene = following_pairs(pairs=2, moments=60)
    sample = hidden_objects(scene, VELOCITY, SENSORS, ONCE)
    tracks = sample.recorded.tracks
    assert sample.place.shape[1:] == (3, 2)
    assert (np.isfinite(tracks.mean[sample.start]).all(axis=1)).all()
    for w in range(len(sample)):
        around = sample.neighbours[w][:, 0]
        known = around >= 0
        apart = np.hypot(*(tracks.mean[around[known], :2] - tracks.mean[sample.start[w], :2]).T)
        assert abs(apart[0] - GAP) < 8
    first = int(np.flatnonzero(sample.known.all(axis=1))[0])
    step = np.diff(np.vstack([tracks.mean[sample.start[first], :2], sample.place[first]]), axis=0)
    assert (np.abs(step[:, 0] - 8.0 * 0.5) < 2.5).all()
    late = ~sample.known[:, -1]
    assert late.any(), "the recording ends within some gaps"
    prediction = sample.predict(VELOCITY, ())
    assert np.isfinite(prediction.position[sample.known]).all()


def test_gaps_of_several_recordings_are_predicted_as_each_by_itself():
    parts = [hidden_objects(following_pairs(pairs=2, moments=50, seed=k), FADING, SENSORS, ONCE) for k in (0, 1)]
    together = HiddenObjects.pooled(parts).predict(FADING, (FOLLOW,))
    apart = [part.predict(FADING, (FOLLOW,)) for part in parts]
    np.testing.assert_allclose(together.position, np.concatenate([each.position for each in apart]), atol=1e-6)
    np.testing.assert_allclose(together.P, np.concatenate([each.P for each in apart]), atol=1e-9)


def test_of_many_gaps_some_are_chosen_the_same_every_time():
    sample = hidden_objects(following_pairs(pairs=3, moments=60), VELOCITY, SENSORS, ONCE)
    few = sample.sampled(5, seed=1)
    assert len(few) == 5
    assert set(few.start.tolist()) <= set(sample.start.tolist())
    np.testing.assert_array_equal(sample.sampled(5, seed=1).start, few.start)
    assert sample.sampled(len(sample), seed=1) is sample


def test_no_rate_makes_a_gap_run_away():
    sample = hidden_objects(following_pairs(pairs=2, moments=60), VELOCITY, SENSORS, ONCE)
    stiff = Neighbours(rate=1e3, distance_scale=50.0, min_speed=0.0)
    prediction = sample.predict(VELOCITY, (stiff,))
    assert np.nanmax(np.abs(prediction.position - sample.place)) < 50


def test_nothing_to_learn_from_and_nonlinear_interactions():
    scene = following_pairs(pairs=1, moments=5)
    assert hidden_objects(scene, VELOCITY, SENSORS) is None
    with pytest.raises(InputError, match="expected ground truth"):
        hidden_objects(dataclasses.replace(scene, ground_truth=None), VELOCITY, SENSORS)
    sample = hidden_objects(following_pairs(pairs=1, moments=40), VELOCITY, SENSORS, ONCE)
    with pytest.raises(InputError, match="linear motions and interactions"):
        sample.predict(VELOCITY, (Repulsion(),))
    with pytest.raises(InputError, match="or mixtures"):
        sample.predict(settings_of(Mixture()), ())
