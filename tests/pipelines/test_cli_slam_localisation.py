"""`saga-fg slam scans --map`: a run that localises in the map of another, and options that do not go with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.slam.drive import SlamMap, read_map, write_map
from tests.pipelines.command import done

POINT = SlamMap([np.ones((1, 3), dtype=np.float32)], np.eye(4)[None])


def test_what_a_configuration_adds_is_refused_in_a_map(
    recordings: Path, tmp_path: Path, subtests: pytest.Subtests
) -> None:
    for name in ["providers", "landmarks"]:
        with subtests.test(name=name):
            write_map(tmp_path, POINT)
            (tmp_path / "own.yaml").write_text(f"slam: {{{name}: [own:Own]}}\n")
            command = ["slam", "scans", str(recordings / "kitti"), "--map", str(tmp_path)]
            outcome = CliRunner().invoke(
                app, [*command, "--config", str(tmp_path / "own.yaml"), "--output", str(tmp_path / "out")]
            )
            assert outcome.exit_code != 0
            assert "--config: slam.providers, slam.landmarks: expected without --map" in " ".join(
                outcome.output.split()
            )


@pytest.mark.parametrize("guess", ["1,2", "1,2,3,x", "1,2,3,nan"])
def test_a_guess_that_is_none_is_named(recordings: Path, tmp_path: Path, guess: str) -> None:
    write_map(tmp_path, POINT)
    command = ["slam", "scans", str(recordings / "kitti"), "--map", str(tmp_path), "--guess", guess]
    outcome = CliRunner().invoke(app, [*command, "--output", str(tmp_path / "out")])
    assert outcome.exit_code != 0
    assert f"--guess: expected x,y,z,yaw, m and rad, got '{guess}'" in " ".join(outcome.output.split())


def test_options_that_a_map_has_no_use_for_are_refused(tmp_path: Path) -> None:
    command = ["slam", "scans", str(tmp_path), "--map", str(tmp_path), "--output", str(tmp_path / "o")]
    outcome = CliRunner().invoke(app, [*command, "--no-landmarks"])
    assert outcome.exit_code != 0
    assert "--map: expected without" in outcome.output


def test_the_command_localises_in_a_map_it_has_written(recordings: Path, tmp_path: Path) -> None:
    options = ["slam", "scans", str(recordings / "kitti")]
    done(*options, "--scans", "20", "--no-landmarks", "--output", tmp_path / "first")
    assert read_map(tmp_path / "first").origin is not None
    again = ["--scans", "10", "--map", str(tmp_path / "first"), "--guess", "0.5,0.3,0,-1.2", "--sensors", "gps,wheels"]
    again += ["--output"]
    outcome = done(*options, *again, tmp_path / "again")
    assert "registered with the map, the first of them scan 0" in outcome.stdout
    assert "in the map's frame: ATE 0." in outcome.stdout
    (tmp_path / "first" / "map" / "origin.csv").unlink()
    outcome = CliRunner().invoke(app, [*options, *again, str(tmp_path / "nowhere")])
    assert outcome.exit_code != 0
    assert "expected a map with origin.csv" in " ".join(outcome.output.split())
    fixes = tmp_path / "fixes.csv"
    fixes.write_text("time [s],x [m],y [m],z [m]\n0.1,0.1,0,0\n0.5,0.2,0,0\n")
    own = [*again[: again.index("--sensors")], "--sensor-log", f"gps={fixes}", "--output", str(tmp_path / "metres")]
    done(*options, *own)


def test_a_map_is_not_written_over(tmp_path: Path) -> None:
    command = ["slam", "scans", str(tmp_path), "--sequence", "0000"]
    result = CliRunner().invoke(app, [*command, "--map", str(tmp_path), "--output", str(tmp_path)])
    assert result.exit_code != 0
    assert "--output: expected another folder than that of --map" in f"{result.output}{result.exception}"
