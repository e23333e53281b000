"""The shipped configuration: every kind of data has one, each is valid, and users' files lie over it."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from data_tools.simulator import SimulatorSettings
from pipelines.config import Family, TrackConfig, load_config
from pipelines.configuration import read_settings, settings_reference, write_settings
from pipelines.configuration.reading import settings_of
from saga_fg import InputError, Tracker
from saga_fg.providers import Gps, Landmarks, Odometry, StartSettings


def test_shipped_defaults_are_valid_and_survive_the_round_trip() -> None:
    for family in get_args(Family):
        config = load_config(family)
        assert read_settings(TrackConfig, write_settings(config)) == config


def test_a_users_file_lies_over_the_shipped_defaults(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("tracker: {max_delay: 0.25}\nsensors: {radar: {time_offset: -0.05}}\n")
    config = load_config("kitti", path)
    assert config.tracker.max_delay == 0.25
    assert config.sensors["radar"].time_offset == -0.05
    assert config.sensors["radar"].score == load_config("kitti").sensors["default"].score
    assert config.greedy == load_config("kitti").greedy


def test_a_mistake_in_a_users_file_names_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("tracker:\n  existence:\n    delete_belw: 0.3\n")
    with pytest.raises(InputError) as caught:
        load_config("nuscenes", path)
    assert str(caught.value) == f"{path}: tracker.existence.delete_belw: unknown key, did you mean 'delete_below'?"


def test_every_setting_explains_itself() -> None:
    for settings in [TrackConfig, SimulatorSettings]:

        def unexplained(cls: type, where: str) -> list[str]:
            found = [f"{where}.{item.name}" for item in settings_of(cls) if not item.comment]
            for item in settings_of(cls):
                schema = item.schema
                while not hasattr(schema, "classes") and (hasattr(schema, "value") or hasattr(schema, "items")):
                    schema = schema.value if hasattr(schema, "value") else schema.items[0]
                for below in getattr(schema, "classes", ()):
                    found += unexplained(below, f"{where}.{item.name}")
            return found

        assert unexplained(settings, settings.__name__) == []
        assert settings_reference(settings).count("|  |") == 0


PROVIDERS = """
tracker:
  estimator: isam2
  providers:
    - {kind: "saga_fg.providers:Odometry", start: {place: [1, 2, 0.1], deviation: 0.3}}
    - {kind: "saga_fg.providers:Gps", deviation: 0.5}
    - saga_fg.providers:Landmarks
"""


def test_providers_have_settings_of_their_own() -> None:
    config = read_settings(TrackConfig, PROVIDERS)
    start = StartSettings(place=(1.0, 2.0, 0.1), deviation=0.3)
    assert config.tracker.providers == (Odometry(start), Gps(deviation=0.5), "saga_fg.providers:Landmarks")
    assert read_settings(TrackConfig, write_settings(config)) == config
    assert Tracker(config.tracker).providers == (Odometry(start), Gps(deviation=0.5), Landmarks())


def test_settings_of_providers_that_make_no_sense() -> None:
    for provider, message in [
        ('{kind: "saga_fg.providers:Gps", deviation: -1}', r"providers\[0\]: deviation: expected a finite number > 0"),
        ('{kind: "saga_fg.providers:Gps", deviaton: 1}', r"providers\[0\].deviaton: unknown key, did you mean"),
        ('{kind: "saga_fg.providers:Gps", deviation: far}', r"providers\[0\].deviation: expected a number, got"),
        ('{kind: "saga_fg.providers:Odometry", start: {place: [0, 0]}}', r"start.place: expected a list of 3"),
        ("{deviation: 1}", r"providers\[0\].kind: expected MODULE:NAME, got nothing"),
        ('{kind: "math:sqrt"}', r"providers\[0\].kind: math:sqrt: expected a dataclass"),
        ('{kind: "no_such_module:X"}', r"providers\[0\].kind: .*expected a module that can be imported"),
        ("3", r"providers\[0\]: expected a section \(key: value\), got 3"),
    ]:
        with pytest.raises(InputError, match=message):
            read_settings(TrackConfig, f"tracker: {{estimator: isam2, providers: [{provider}]}}")


def test_a_sensor_that_is_not_finite_is_refused_with_file_and_key(tmp_path: Path) -> None:
    for setting, message in [
        ("extrinsics: {x: .nan}", "sensors.lidar.extrinsics: x: expected a finite number, got nan"),
        ("extrinsics: {yaw: .inf}", "sensors.lidar.extrinsics: yaw: expected a finite number, got inf"),
    ]:
        path = tmp_path / "mine.yaml"
        path.write_text(f"sensors:\n  lidar:\n    {setting}\n")
        with pytest.raises(InputError) as caught:
            load_config("nuscenes", path)
        assert str(caught.value) == f"{path}: {message}"
