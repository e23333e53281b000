"""Noise learned from simulated traffic, with and without ground truth, is the noise the sensors were simulated with."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from data_tools.datasets.detection_files import read_detections
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.cli import app
from pipelines.config import TrackConfig, load_config
from pipelines.learning import LearnedNoise, learn_noise, learned_fragment
from saga_fg import ConstantVelocity
from saga_fg.learning import sample_with_truth
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.types.by_class import DEFAULT

WORLD = SimulatorSettings(duration=8.0)
WORST = 1.35  # factor between what was learned and the truth, at ranges where traffic is


@pytest.fixture(scope="module", params=[True, False], ids=["with truth", "without truth"])
def learned(request: pytest.FixtureRequest) -> LearnedNoise:
    """Noise learned from a start that is wrong everywhere."""
    start = load_config("simulated")
    wrong = Sensor(noise={DEFAULT: NoiseModel(position=0.3, range_noise=0.01, bearing_noise=0.01)})
    start = replace(start, sensors={DEFAULT: wrong})
    dataset = SimulatedTraffic(WORLD, scenes=2, seed=7)
    return learn_noise(dataset, dataset.scenes, start, with_truth=request.param)


def acceleration_noise(config: TrackConfig) -> float:
    motion = config.tracker.classes[DEFAULT].motion
    assert isinstance(motion, ConstantVelocity)
    return motion.acceleration_noise


def test_deviations(learned: LearnedNoise) -> None:
    for name, truth in WORLD.sensors.items():
        noise = learned.config.sensors[name].noise[DEFAULT]
        pairs = (noise.range_noise, truth.range_noise), (noise.bearing_noise, truth.bearing_noise)
        for distance in (12.0, 25.0, 40.0):
            for slope, (base, growth) in pairs:
                ratio = math.hypot(noise.position, slope * distance) / (base + growth * distance)
                assert 1 / WORST < ratio < WORST
        assert noise.yaw == pytest.approx(truth.yaw_noise, rel=0.2)
        assert noise.height == pytest.approx(truth.height_noise, rel=0.2)
    assert learned.config.sensors["camera"].noise[DEFAULT].velocity == pytest.approx(1.0, rel=0.2)


def test_scores_are_worth_on_another_scene_what_was_learned(
    learned: LearnedNoise, request: pytest.FixtureRequest
) -> None:
    with_truth = request.node.callspec.params["learned"]
    other = SimulatedTraffic(WORLD, scenes=1, seed=8)
    for name, (sample, _) in sample_with_truth([other.scene(other.scenes[0])], learned.config.sensors).items():
        p, raw = (sensor.calibrated(sample.logit, sample.label) for sensor in (learned.config.sensors[name], Sensor()))
        loss, before = (-np.log(np.where(sample.true, q, 1 - q)).mean() for q in (p, raw))
        assert loss < (1.0 if with_truth else 1.1) * before  # what comes back counts as true, be it clutter
        assert p.mean() == pytest.approx(sample.true.mean(), abs=0.1 if with_truth else 0.15)


def test_fields_of_view_and_chances(learned: LearnedNoise) -> None:
    lidar, camera = learned.config.sensors["lidar"], learned.config.sensors["camera"]
    half = math.radians(60)
    assert camera.field_of_view.min_azimuth == pytest.approx(-half, abs=0.1)
    assert camera.field_of_view.max_azimuth == pytest.approx(half, abs=0.1)
    assert lidar.field_of_view.max_azimuth - lidar.field_of_view.min_azimuth == pytest.approx(2 * math.pi)
    assert 0.8 < lidar.detection_probability <= 0.97
    assert 0.5 < camera.detection_probability <= 0.9


def test_the_fragment_leads_to_the_learned_settings(learned: LearnedNoise, tmp_path: Path) -> None:
    path = tmp_path / "noise.yaml"
    path.write_text(learned_fragment(learned, "a test"))
    config = load_config("simulated", path)
    for name, sensor in learned.config.sensors.items():
        if name in learned.detections:
            assert config.sensors[name].noise[DEFAULT].position == pytest.approx(
                sensor.noise[DEFAULT].position, rel=1e-3
            )
            assert config.sensors[name].field_of_view.max_range == pytest.approx(
                sensor.field_of_view.max_range, rel=1e-3
            )
    q = learned.config.tracker.classes[DEFAULT].motion.acceleration_noise  # type: ignore[union-attr]
    assert config.tracker.classes[DEFAULT].motion.acceleration_noise == pytest.approx(q, rel=1e-3)  # type: ignore[union-attr]


def test_process_noise_is_alike_with_and_without_truth() -> None:
    dataset = SimulatedTraffic(WORLD, scenes=1, seed=3)
    start = load_config("simulated")
    with_truth, without = (
        acceleration_noise(learn_noise(dataset, dataset.scenes, start, truth).config) for truth in (True, False)
    )
    assert 0.5 < with_truth / without < 2.0


def test_the_command_learns_from_a_file_without_truth_and_tracks_with_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = ["timestamp,x,y,label,score"]
    for k in range(60):
        for lane in range(4):
            x, y = np.array([8.0 * k / 10 + 15 * lane, 4.0 * lane]) + 0.25 * rng.standard_normal(2)
            rows.append(f"{k / 10},{x},{y},car,0.8")
    detections, noise, tracks = (tmp_path / name for name in ("detections.csv", "noise.yaml", "tracks.csv"))
    detections.write_text("\n".join(rows))
    result = CliRunner().invoke(app, ["learn", "noise", "file", str(detections), "-o", str(noise)])
    assert result.exit_code == 0, result.output
    assert "240 detections" in result.output
    position = yaml.safe_load(noise.read_text())["sensors"]["sensor"]["noise"]["default"]["position"]
    assert position == pytest.approx(0.25, rel=0.15)
    result = CliRunner().invoke(app, ["track", "file", str(detections), "--config", str(noise), "-o", str(tracks)])
    assert result.exit_code == 0, result.output


def test_where_nothing_was_detected_nothing_is_learned(tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_text("timestamp,x,y\n0.0,,\n0.1,,\n")
    result = CliRunner().invoke(
        app, ["learn", "noise", "file", str(tmp_path / "empty.csv"), "-o", str(tmp_path / "noise.yaml")]
    )
    assert result.exit_code == 2
    assert "expected detections to learn from" in result.output
    assert not (tmp_path / "noise.yaml").exists()


def test_few_detections_are_worth_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [f"{k / 10},{0.8 * k},0.0" for k in range(4)]
    (tmp_path / "few.csv").write_text("\n".join(["timestamp,x,y", *rows]))
    dataset = read_detections(tmp_path / "few.csv")
    learn_noise(dataset, dataset.scenes, load_config("file"), with_truth=False)
    assert "learned from 4 detections only" in caplog.text
