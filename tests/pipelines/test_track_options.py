"""Options of `saga-fg track` that contradict each other or would destroy the input are refused."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from pipelines.cli import app

ROWS = "timestamp,x,y\n0.0,1.0,2.0\n0.1,1.5,2.0\n"


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["track", "file", *arguments])
    return result.exit_code, result.output


def test_an_option_without_effect_is_refused(tmp_path: Path) -> None:
    for arguments, message in [
        (("--method", "centerpoint", "--estimator", "isam2"), "has no estimator"),
        (("--method", "centerpoint", "--association", "graph"), "has its own"),
        (("--lag", "1"), "goes with --estimator fixed-lag"),
        (("--estimator", "kalman", "--lag", "1"), "goes with --estimator fixed-lag"),
    ]:
        detections, output = tmp_path / "detections.csv", tmp_path / "tracks.csv"
        detections.write_text(ROWS)
        code, text = run(str(detections), "--output", str(output), *arguments)
        assert code == 2
        assert message in text
        assert not output.exists()


def test_the_output_may_not_be_the_input(tmp_path: Path) -> None:
    detections = tmp_path / "detections.csv"
    detections.write_text(ROWS)
    code, text = run(str(detections), "--output", str(detections))
    assert code == 2
    assert "another file" in text
    assert detections.read_text() == ROWS


def test_a_place_without_digits_is_refused(tmp_path: Path) -> None:
    detections = tmp_path / "detections.csv"
    detections.write_text("timestamp,x,y\n0.0,1e200,2.0\n0.0,0.0,1.0\n")
    code, text = run(str(detections), "--output", str(tmp_path / "tracks.csv"))
    assert code == 2
    assert "within 1e+09" in text


def test_the_way_of_matching_is_an_option(tmp_path: Path) -> None:
    """Two cars cross at one place: told to take the nearest pair first, the tracker does something else."""
    detections = tmp_path / "detections.csv"
    detections.write_text("timestamp,x,y\n0.0,0.0,0.0\n0.0,3.0,0.0\n0.5,2.0,0.0\n0.5,6.0,0.0\n")
    tracks = {}
    for method in ("hungarian", "greedy", "graph"):
        output = tmp_path / f"{method}.csv"
        assert run(str(detections), "--output", str(output), "--association", method)[0] == 0
        tracks[method] = output.read_text()
    assert tracks["graph"] == tracks["hungarian"] != tracks["greedy"]
