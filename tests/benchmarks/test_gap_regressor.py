"""The outside judge of the benchmark of gaps: its features, and what it learns."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.gaps import boosted
from benchmarks.gaps.boosted import NAME, BoostedTrees, boosted_runs
from benchmarks.gaps.features import Features
from benchmarks.gaps.sources import RecordingSource
from benchmarks.gaps.tables import tables
from data_tools.simulator import SimulatorSettings, simulate_scene
from pipelines.config import load_config
from pipelines.learning.gap_runs import GapBenchSettings
from saga_fg import InputError
from saga_fg.errors import MissingExtraError
from saga_fg.learning.gaps import Gap, made_gaps
from saga_fg.learning.labelled_scene import LabelledScene
from tests.pipelines.test_situations import GAP, STEADY, TIMES, along, labelled

SHORT = replace(SimulatorSettings(), duration=12.0, warm_up=5.0)


def test_features_are_those_of_the_detections_and_the_leader() -> None:
    ahead = along(np.where(TIMES < 1.0, 5 * TIMES, 5.0) + 20)  # it stops when the gap begins
    features = Features.of(labelled({"a": STEADY, "b": ahead}, colour="red"), GAP)
    assert features is not None
    speed, along_axis, left, *_ = features.known.tolist()
    assert (speed, along_axis, left) == pytest.approx((5.0, 5.0, 0.0), abs=1e-6)
    assert features.leader == 1
    row = features.until(GAP.stop - 1)
    assert row[-4:] == pytest.approx([0.0, 0.0, 1.0, 2.0]), "the leader's way, twice; closed; seconds"
    for offset in (np.zeros(2), np.array([3.0, -1.0])):
        place = features.place(offset, GAP.stop - 1)
        assert features.offset(place, GAP.stop - 1) == pytest.approx(offset)
    assert features.place(np.zeros(2), GAP.stop - 1) == pytest.approx([15.0, 0.0], abs=1e-6)


def test_what_is_not_known_is_nan() -> None:
    alone = Features.of(labelled({"a": STEADY}, road=None), GAP)
    assert alone is not None
    assert alone.leader is None
    assert np.isnan(alone.until(GAP.stop - 1)[-4:-1]).all()
    unseen = labelled({"a": STEADY, "b": along(5 * TIMES + 12)}, unseen=("a",))
    assert Features.of(unseen, GAP) is None, "no detection tells its state"


def test_trees_learn_who_slows_down(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sklearn")
    monkeypatch.setattr(boosted, "FEWEST", 20)
    monkeypatch.setattr(boosted, "TREES", boosted.TREES | {"max_iter": 30})
    monkeypatch.setattr(RecordingSource, "scene", lambda self, name: simulate_scene(SHORT, seed=int(name)))
    config, settings = load_config("simulated"), GapBenchSettings(1, ("kept",), (2.0,))
    source = RecordingSource("simulated")
    (run,) = boosted_runs(source, ["1"], ["2"], settings, config.sensors)
    wanted = made_gaps(LabelledScene.of(source.scene("2"), config.sensors), 1, 0, (2.0,))
    assert (run.contender, run.recording, run.gaps) == (NAME, "2", tuple(wanted))
    errors = [outcome.predicted[2.0].error for outcome in run.outcomes]
    assert np.isfinite(errors).all()
    assert np.median(errors) < 4.0
    titles = {table.title: table for table in tables("simulated", [run], NAME, situations=True)}
    assert set(titles) == {"simulated, tracks kept alive: made gaps", *(t for t in titles if "by situation" in t)}
    assert "-" in titles["simulated, tracks kept alive: made gaps"].rows[0], "it keeps no identities"
    assert boosted_runs(source, ["1"], ["2"], replace(settings, lives=("shipped",)), config.sensors) == []


def test_too_little_to_learn_from_and_a_missing_package_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = labelled({"a": STEADY})
    monkeypatch.setattr(boosted, "_regressor", lambda: None)
    with pytest.raises(InputError, match="--fit boosted: expected recordings with 100 windows"):
        BoostedTrees.fitted([scene])
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    with pytest.raises(MissingExtraError, match=r"scikit-learn: pip install 'saga-fg\[bench\]'"):
        BoostedTrees.fitted([scene])
    unknown = BoostedTrees({}).outcome(scene, Gap(0, 5, 16, 2.0, moving=True))
    assert (unknown.kept, unknown.reported, dict(unknown.predicted)) == (None, None, {})
