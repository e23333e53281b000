"""`saga-fg learn interactions`, and what tracking does with its file."""

from functools import partial

import numpy as np
import pipelines.learning.interactions
import pytest
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.config import load_config, load_interactions
from saga_fg.learning import fit_interactions
from saga_fg.model.edge_rules import Following, Neighbours

run = CliRunner().invoke


@pytest.fixture(scope="module")
def detections(tmp_path_factory):
    """Two queues of four cars and a row of parked ones, as a table of detections."""
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("queue") / "detections.csv"
    lines = ["timestamp,x,y,yaw,label,score"]
    speed, x = np.full(8, 8.0), np.array([30.0, 20, 10, 0, 30, 20, 10, 0])
    lane = np.array([0.0] * 4 + [60.0] * 4)
    for k in range(36):
        for i in range(8):
            lines.append(f"{0.25 * k:.2f},{x[i] + rng.normal(0, 0.05):.3f},{lane[i]:.3f},0.0,car,0.9")
        for i in range(3):
            lines.append(f"{0.25 * k:.2f},{8 * i + rng.normal(0, 0.05):.3f},{8 + rng.normal(0, 0.05):.3f},0.0,car,0.9")
        leaders = [0, 4]
        speed[leaders] += rng.normal(0, 0.4, 2)
        for lead in leaders:
            for i in range(lead + 1, lead + 4):
                speed[i] += 0.25 * (speed[i - 1] - speed[i])
        x = x + 0.25 * speed
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def learned(detections):
    output = detections.parent / "interactions.yaml"
    with pytest.MonkeyPatch.context() as patch:  # the way to the file is tested here, not how good the fit is
        patch.setattr(pipelines.learning.interactions, "fit_interactions", partial(fit_interactions, iterations=3))
        result = run(app, ["learn", "interactions", "file", str(detections), "--output", str(output)])
    assert result.exit_code == 0, result.output
    return output


def test_edges_are_learned_from_unlabelled_detections(learned):
    interactions = load_interactions(learned)
    assert {type(rule) for rule in interactions.edges} == {Following, Neighbours}
    assert interactions.acceleration_noise["default"] > 0
    assert "1 recording" in interactions.learned_from


def test_a_tracker_takes_them_over(learned, detections):
    config = load_config("file").with_interactions(load_interactions(learned))
    assert config.tracker.edges == load_interactions(learned).edges
    tracks = detections.parent / "tracks.csv"
    arguments = ["track", "file", str(detections), "--interactions", str(learned), "--output", str(tracks)]
    assert run(app, arguments).exit_code == 0
    assert len(tracks.read_text(encoding="utf-8").splitlines()) > 200


def test_mistakes_are_answered_with_one_line(learned, detections):
    wrong = detections.parent / "wrong.yaml"
    wrong.write_text("version: 9\n", encoding="utf-8")
    track = ["track", "file", str(detections), "--output", str(detections.parent / "t.csv")]
    result = run(app, [*track, "--interactions", str(wrong)])
    assert result.exit_code == 2
    assert "wrong.yaml: version: expected 1" in result.output
    result = run(app, [*track, "--interactions", str(learned), "--method", "kf"])
    assert result.exit_code == 2
    assert "goes with --method saga" in result.output


def test_the_detections_are_not_overwritten(detections):
    before = detections.read_bytes()
    result = run(app, ["learn", "interactions", "file", str(detections), "--output", str(detections)])
    assert result.exit_code == 2
    assert "expected another file than those that are read" in result.output
    assert detections.read_bytes() == before
