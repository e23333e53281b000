"""The benchmark of gaps and its command from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.gaps import sources
from benchmarks.gaps.contenders import contenders
from benchmarks.gaps.sources import RecordingSource
from benchmarks.gaps.summary import gap_figures
from benchmarks.recordings import simulated_set
from pipelines.config import load_config
from pipelines.learning.gap_runs import GapBenchSettings, bench_gaps, prepared
from saga_fg import InputError
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.learning.situations import situations_of
from tests.pipelines.sampled_gaps import (
    SHORT,
    scene,
    straight,
)


@pytest.mark.usefixtures("short_scenes")
def test_gaps_may_be_of_some_situations_alone() -> None:
    source = RecordingSource("simulated", scenes=1, labels=True)
    settings = GapBenchSettings(1, ("kept",), (2.0,), of=("visible leader", "turning"))
    labelled, gaps = prepared(source, "scene-0001", settings, load_config("simulated").sensors)
    made = [gap for gap in gaps if gap.run > 0]
    assert made
    found = [situations_of(labelled, gap)[2.0] for gap in made]
    assert all(each & {"visible leader", "turning"} for each in found)
    assert any("visible leader" in each for each in found)


def test_scenes_without_truth_or_detections_are_refused() -> None:
    drawn = scene({"a": straight()}, {"a": straight()})
    with pytest.raises(InputError, match="scene drawn: expected ground truth"):
        LabelledScene.of(replace(drawn, ground_truth=None), {})
    with pytest.raises(InputError, match="scene drawn: expected detections"):
        LabelledScene.of(replace(drawn, frames=[]), {})


@pytest.mark.usefixtures("short_scenes")
def test_contenders_are_judged_on_the_same_gaps() -> None:
    base = load_config("simulated")
    source = RecordingSource("simulated", scenes=1)
    compared = [contenders("simulated")[name].contender(base) for name in ("saga", "kf")]
    saga, kf = bench_gaps(source, ["scene-0001"], compared, GapBenchSettings(passes=1, lives=("kept",)))
    assert saga.gaps == kf.gaps
    assert len(saga.gaps) > 3
    figures = gap_figures([saga, kf], "kf")
    for ours, theirs in zip(figures[::2], figures[1::2], strict=True):
        assert (ours.contender, theirs.contender) == ("saga", "kf")
        assert (ours.gaps, ours.group, ours.length) == (theirs.gaps, theirs.group, theirs.length)
        assert np.isnan(ours.kept.low), "one recording has no interval"
        if ours.error_change is not None and ours.measured:
            assert ours.error_change.estimate == pytest.approx(ours.error.estimate / theirs.error.estimate - 1)


@pytest.mark.usefixtures("short_scenes")
def test_the_command_prints_tables_and_writes_figures(tmp_path: Path) -> None:
    own, out = tmp_path / "own.yaml", tmp_path / "gaps.json"
    own.write_text("tracker: {explained_noise: 0.5}\n")
    arguments = ["gaps", "--sets", "simulated", "--scenes", "1", "--passes", "1", "--life", "kept"]
    arguments += ["--situations", "--lengths", "2"]
    arguments += ["--contenders", "kf", "--contender", f"own:saga={own}", "--json", str(out)]
    arguments += ["--plot", str(tmp_path / "gaps.png")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "real gaps of 1 to 6 s" in result.output
    assert (tmp_path / "gaps.png").read_bytes().startswith(b"\x89PNG")
    figures = json.loads(out.read_text())["simulated"]
    assert figures["recordings"] == ["scene-0001"]
    assert {row["contender"] for row in figures["gaps"]} == {"kf", "own"}
    assert {row["life"] for row in figures["outcomes"]} == {"kept"}
    assert {row["length"] for row in figures["outcomes"] if row["run"]} == {2.0}
    assert "after 2 s, by situation" in result.output
    everything = next(row for row in figures["situations"] if row["situation"] == "all")
    assert everything["gaps"] + everything["lost"] == sum(row["run"] > 0 for row in figures["outcomes"]) / 2


def test_the_command_refuses_recordings_without_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = replace(SHORT, duration=1.0)
    monkeypatch.setattr(sources, "_set", lambda name, data, scenes, *_: simulated_set(scenes, settings=settings))
    arguments = ["gaps", "--sets", "simulated", "--scenes", "1", "--passes", "1", "--contenders", "kf"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "expected recordings with gaps, there is none" in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--contenders", "nobody"], "--contenders: unknown contender"),
        (["--contender", "own"], "expected NAME=FILE"),
        (["--against", "turn", "--contenders", "saga,kf"], "--against: unknown contender"),
        (["--contenders", "saga"], "add kf to --contenders or give another --against"),
        (["--viewpoint", "mast"], "--viewpoint: expected ngsim or openacc among --sets"),
        (["--longest", "20"], "--longest: expected ngsim or openacc among --sets"),
        (["--picture", "gap.jpg"], "gap.jpg: expected a name that ends in .png"),
        (["--test", "scene-0099"], "--test: unknown recording"),
        (["--train", "scene-0001", "--test", "scene-0001"], "in one of them only"),
        (["--train", "scene-0001", "--plot", "gaps.png"], "set simulated: expected recordings to judge"),
        (["--passes", "0", "--plot", "gaps.png"], "--plot: expected --passes of 1 or more"),
        (["--fit", "edge"], "--fit: expected some of noise, edges, boosted, got 'edge'"),
        (["--fit", "edges"], "--fit: expected --train or --folds"),
        (["--fit", "boosted", "--folds", "2", "--life", "shipped"], "--fit boosted: expected --life kept or both"),
        (["--of", "halting,red"], "--of: unknown situation 'red'"),
        (["--folds", "1"], "--folds: expected a number of 2 or more, or place, got '1'"),
        (["--lengths", "4"], "--lengths: expected some of 1, 2, 3, 5, got '4'"),
        (["--situations", "--life", "shipped"], "--situations: expected --life kept or both"),
        (["--sets", "foo"], "megvii, centerpoint, camera, kitti, simulated, ngsim, openacc, argoverse2, eth_ucy"),
    ],
)
def test_the_command_refuses(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["gaps", "--sets", "simulated", "--scenes", "1", *arguments])
    assert result.exit_code == 2
    assert message in result.output
