"""The tracking benchmark: variants by named settings, changes with intervals, and recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.recording_sets import Score, chosen_sets, simulated_set
from benchmarks.tracking import changes, set_rows
from benchmarks.variants import COMPONENTS, changed, contenders, variants
from data_tools.metrics import LabelErrors
from data_tools.simulator import SimulatorSettings
from pipelines.cli import app as product
from pipelines.config import Family, load_config
from saga_fg import InputError
from saga_fg.model.edge_rules import Following

FAMILIES: tuple[Family, ...] = ("nuscenes", "kitti", "simulated", "file")
SHORT = replace(SimulatorSettings(), duration=6.0, warm_up=5.0)


def test_every_component_is_a_setting_of_every_kind_of_data() -> None:
    for family in FAMILIES:
        base = load_config(family)
        found = contenders(family, base, ",".join(("saga", "kf", *(variant.name for variant in COMPONENTS))), ())
        assert all(one.config != base for one in found[2:]), "what changes nothing is left out"
        assert len({one.name for one in found}) == len(found) > 8


def test_settings_are_changed_by_their_dotted_names() -> None:
    base = load_config("nuscenes")
    every = changed(base, "tracker.classes.*.gate", 0.5)
    assert {each.gate for each in every.tracker.classes.values()} == {0.5}
    one = changed(base, "tracker.classes.car.gate", 0.5)
    assert one.tracker.classes["car"].gate == 0.5
    assert one.tracker.classes["default"] == base.tracker.classes["default"]
    without = variants("simulated")["without following"].contender(load_config("simulated")).config
    assert not any(isinstance(edge, Following) for edge in without.tracker.edges)
    for name in ("tracker.nothing", "tracker.classes.plane.gate", "tracker.report_coasting.more"):
        with pytest.raises(InputError, match="expected"):
            changed(base, name, 0.0)


def label_errors(velocity: float) -> LabelErrors:
    n = 5
    column = np.full(n, 1.0)
    fields = {"detection": column, "position": column, "heading": column, "nees": column}
    return LabelErrors(
        np.full(n, "car"), np.arange(n), column, np.ones(n, bool), velocity=np.full(n, velocity), **fields
    )


def test_changes_are_those_of_the_same_scenes() -> None:
    errors = tuple(label_errors(v) for v in (1.0, 2.0, 3.0))
    better = tuple(label_errors(0.5 * v) for v in (1.0, 2.0, 3.0))
    saga = Score(lambda rows: {"MOTA": 0.5 + 0.01 * sum(rows), "IDS": 2.0 * len(rows)}, better)
    kf = Score(lambda rows: {"MOTA": 0.4 + 0.01 * sum(rows), "IDS": 1.0 * len(rows)}, errors)
    for units in ([[0], [1], [2]], [[0, 2], [1]]):
        found = changes(saga, kf, units, 20)
        assert found["MOTA"].estimate == pytest.approx(0.1)
        assert found["MOTA"].low == pytest.approx(0.1)
        assert found["velocity RMSE"].estimate == pytest.approx(-0.5)
        assert found["IDS, relative"].estimate == pytest.approx(1.0)
        assert found["position RMSE"].low <= 0.0 <= found["position RMSE"].high
    assert changes(saga, kf, [[0, 1, 2]], 20) == {}


def test_a_set_is_tracked_by_every_variant() -> None:
    base = load_config("simulated")
    compared = contenders("simulated", base, "saga,kf,centerpoint,without following", ())
    rows = list(set_rows(simulated_set(2, settings=replace(SHORT, duration=1.0)), compared, 5))
    accuracy = {row["variant"]: row for title, row in rows if "RMSE of position" in title}
    assert set(accuracy) == {"saga", "kf", "centerpoint", "without following"}
    assert {"MOTA", "IDS", "hidden RMSE"} <= set(accuracy["saga"])
    assert accuracy["centerpoint"]["/ centerpoint"] == 1.0
    assert all(row["ms / frame"] > 0 for row in accuracy.values())
    against = {row["variant"]: row for title, row in rows if "changes from kf" in title}
    assert set(against) == {"saga", "without following"}
    expected = accuracy["saga"]["position"] / accuracy["kf"]["position"] - 1
    assert against["saga"]["position RMSE"].estimate == pytest.approx(expected)


def test_recordings_are_chosen_by_name() -> None:
    (chosen,) = chosen_sets("simulated", None, 3, "scene-0003")
    assert (chosen.name, chosen.family, chosen.dataset.scenes) == ("simulated", "simulated", ("scene-0003",))
    with pytest.raises(InputError, match="--test: unknown name 'scene-0009'"):
        chosen_sets(None, None, 3, "scene-0009")


def test_the_command_on_recordings_in_the_nuscenes_layout(bench, tmp_path: Path) -> None:
    data = tmp_path / "data"
    (tmp_path / "short.yaml").write_text("duration: 4.0\nwarm_up: 5.0\n")
    root = data / "nuscenes"
    data.mkdir()
    options = ["-o", str(root), "--scenes", "2", "--config", str(tmp_path / "short.yaml")]
    assert CliRunner().invoke(product, ["simulate", *options]).exit_code == 0
    (root / "detections" / "lidar.json").rename(root / "detections" / "centerpoint_lidar.json")
    splits = root / "v1.0-mini" / "splits.json"
    splits.write_text(json.dumps({"lidar_centerpoint": ["scene-0001", "scene-0002"]}))
    rows = bench("tracking --sets centerpoint --no-components --draws 3", "--data", str(data))
    accuracy = {row["variant"]: row for row in rows if "AMOTA" in row and "ms / frame" in row}
    assert set(accuracy) == {"saga", "kf", "centerpoint"}
    assert accuracy["saga"]["AMOTA"] > 0.2
    (against,) = [row for row in rows if "changes from kf" in row["table"]]
    assert against["AMOTA"]["estimate"] == pytest.approx(accuracy["saga"]["AMOTA"] - accuracy["kf"]["AMOTA"])


def test_mistakes_are_one_line(refused) -> None:
    for arguments, message in [
        ("--sets moon", "--sets: unknown name 'moon'"),
        ("--sets kitti", "expected --data DIR"),
    ]:
        assert message in refused(f"tracking {arguments}")
