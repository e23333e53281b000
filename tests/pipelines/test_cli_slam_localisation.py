"""`saga-fg slam scans --map`: a run that localises in the map of another, and options that do not go with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.slam.drive import SlamMap, read_map, write_map
from tests.pipelines.command import done, refused

POINT = SlamMap([np.ones((1, 3), dtype=np.float32)], np.eye(4)[None])


def test_what_does_not_go_with_a_map_is_one_line(recordings: Path, tmp_path: Path, subtests: pytest.Subtests) -> None:
    of_map, own = tmp_path / "map", tmp_path / "own.yaml"
    of_map.mkdir()
    write_map(of_map, POINT)
    for options, message in [
        (["--config", own], "--config: slam.providers, slam.landmarks: expected without --map"),
        (["--no-landmarks"], "--map: expected without"),
        (["--output", of_map], "--output: expected another folder than that of --map"),
        *((["--guess", bad], f"--guess: expected x,y,z,yaw, m and rad, got '{bad}'") for bad in ("1,2", "1,2,3,nan")),
    ]:
        for name in ("providers", "landmarks") if own in options else ("",):
            own.write_text(f"slam: {{{name}: [own:Own]}}\n")
            with subtests.test(message):
                command = ["slam", "scans", recordings / "kitti", "--map", of_map, "--output", tmp_path / "out"]
                assert message in " ".join(refused(*command, *options).split())
                assert not (tmp_path / "out").exists()


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
