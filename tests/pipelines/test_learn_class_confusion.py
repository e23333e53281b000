"""Confusion of the classes of a group by a sensor, learned from simulated traffic."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.variants import changed
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import load_config
from pipelines.learning import learn_noise, learned_fragment

VEHICLES = ("bus", "car", "truck")


def test_confusion_is_found_by_sensor(tmp_path):
    simulator = SimulatorSettings(duration=5.0)
    right = {"lidar": 1.0, "camera": 0.7}
    sensors = {name: replace(simulator.sensors[name], class_accuracy=share) for name, share in right.items()}
    dataset = SimulatedTraffic(replace(simulator, sensors=sensors), scenes=1, seed=702)
    start = load_config("simulated")
    learned = learn_noise(dataset, dataset.scenes, changed(start, "tracker.class_groups", (VEHICLES,)), True)
    for name, share in right.items():
        table = learned.config.sensors[name].confusion["car"]
        assert table["car"] == pytest.approx(share, abs=0.06)
        assert table["bus"] == pytest.approx((1 - share) / 2, abs=0.05)
        assert np.sum(list(table.values())) == pytest.approx(1.0, abs=1e-3)
    path = tmp_path / "learned.yaml"
    path.write_text(learned_fragment(learned, "a test"))
    read = load_config("simulated", path)
    assert read.tracker.class_groups == (VEHICLES,)
    assert read.sensors["camera"].confusion == learned.config.sensors["camera"].confusion
    apart = learn_noise(dataset, dataset.scenes, start, True)
    assert not apart.config.sensors["camera"].confusion
    assert "class_groups" not in learned_fragment(apart, "a test")
    assert learned.config.sensors["camera"].detection_probability > apart.config.sensors["camera"].detection_probability
