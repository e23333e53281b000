"""`python -m benchmarks landmarks` on drives made up here: trees told apart, beacons found by ranges alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from benchmarks.app import app
from benchmarks.recordings.ranges import trilateration
from data_tools.trajectories import read_kitti_poses, read_tum_poses


def landmarks(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["landmarks", *map(str, arguments)], catch_exceptions=False)


def rounds(poses: int, rounds: float, radius: float) -> tuple[np.ndarray, float, float]:
    """Poses (N, 3) = x, y, heading on a circle, the length of a step and the turn of one."""
    turn = 2 * np.pi * rounds / poses
    angle = turn * np.arange(poses)
    return np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), angle], axis=1), radius * turn, turn


def park(folder: Path, seed: int = 0) -> tuple[Path, int]:
    """A drive in the format of Victoria Park, with odometry that is worse than it says; how many trees are seen."""
    rng = np.random.default_rng(seed)
    poses, step, turn = rounds(240, 2.2, 15.0)
    angle = np.linspace(0, 2 * np.pi, 17)[:-1]
    trees = np.stack([22 * np.sin(angle), 15 - 22 * np.cos(angle)], axis=1) + rng.uniform(-1.5, 1.5, (16, 2))
    lines, seen = [], set()
    for k, (x, y, heading) in enumerate(poses):
        if k:
            slip = np.array([step, 0.0, turn + 0.002 * np.sin(k / 20)])  # which persists for a while
            dx, dy, dh = slip + rng.normal(0, [0.02, 0.005, 0.004])
            lines.append(f"ODOMETRY {1000 + k - 1} {1000 + k} {dx} {dy} {dh} 4e-4 0 0 2.5e-5 0 4e-6")
        c, s = np.cos(heading), np.sin(heading)
        local = (trees - [x, y]) @ np.array([[c, -s], [s, c]])
        for tree in np.flatnonzero((np.linalg.norm(local, axis=1) < 12) & (local[:, 0] > 0)):
            seen.add(int(tree))
            zx, zy = local[tree] + rng.normal(0, 0.1, 2)
            lines.append(f"LANDMARK {1000 + k} {tree} {zx} {zy} 0.01 0 0.01")
    path = folder / "park.txt"
    path.write_text("\n".join(lines) + "\n")
    return path, len(seen)


def test_trees_are_told_apart_without_their_names(tmp_path: Path) -> None:
    path, trees = park(tmp_path)
    output = tmp_path / "out"
    result = landmarks(path, "--output", output)
    assert result.exit_code == 0
    figures = json.loads((output / "figures.json").read_text())
    assert figures["pairwise F1"] > 0.95
    evidence = {float(scale): value for scale, value in figures["log evidence by odometry scale"].items()}
    assert figures["odometry scale"] == max(evidence, key=lambda scale: evidence[scale]) < 256
    found = json.loads((output / "landmarks.json").read_text())
    assert abs(sum(landmark["observations"] > 2 for landmark in found) - trees) <= 1
    assert all(np.linalg.eigvalsh(landmark["covariance"])[0] > 0 for landmark in found)
    assert len(read_tum_poses(output / "trajectory.tum")) == len(read_kitti_poses(output / "trajectory.kitti")) == 240
    assert (output / "landmarks.ply").read_bytes().startswith(b"ply")
    assert (output / "above.png").read_bytes().startswith(b"\x89PNG")


def beacons(folder: Path) -> Path:
    """A drive in the format of Plaza, whose radio measures 7 % and 0.3 m too much."""
    rng = np.random.default_rng(3)
    poses, *_ = rounds(400, 2.3, 20.0)
    poses[:, :2] += np.stack([6 * np.sin(np.arange(400) / 25), np.zeros(400)], axis=1)
    moved = np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2])
    heading = np.unwrap(np.arctan2(*np.diff(poses[:, :2], axis=0, append=poses[-1:, :2] + moved[-1:]).T[::-1]))
    along = np.linalg.norm(moved, axis=1)
    turned = np.diff(heading, prepend=heading[:1])
    places = {1: (30.0, 5.0), 4: (-25.0, 40.0), 6: (5.0, 20.0)}
    (folder / "B_DR.txt").write_text(
        "\n".join(
            f"{k / 5} {d * (1 + rng.normal(0, 0.02))} {a + rng.normal(0, 0.004)}"
            for k, (d, a) in enumerate(zip(along, turned, strict=True))
        )
    )
    lines = []
    for k in range(0, 400, 2):
        number = [1, 4, 6][k // 2 % 3]
        distance = np.hypot(*(places[number] - poses[k, :2]))
        echo = 8.0 if rng.random() < 0.05 else 0.0
        lines.append(f"{k / 5} 2 {number} {1.07 * distance + 0.3 + rng.normal(0, 0.2) + echo}")
    (folder / "B_TD.txt").write_text("\n".join(lines))
    (folder / "B_GT.txt").write_text("\n".join(f"{k / 5} {x} {y} 0" for k, (x, y, _) in enumerate(poses)))
    (folder / "B_TL.txt").write_text("\n".join(f"{n} {x} {y}" for n, (x, y) in places.items()))
    return folder / "B_DR.txt"


def test_beacons_are_found_by_ranges_alone(tmp_path: Path) -> None:
    output = tmp_path / "out"
    result = landmarks(beacons(tmp_path), "--output", output)
    assert result.exit_code == 0
    assert "ATE, m" in result.stdout
    figures = json.loads((output / "figures.json").read_text())
    assert figures["ATE, m"] < 0.5
    assert figures["ATE, m"] < 0.5 * figures["ATE of dead reckoning, m"]
    assert figures["beacons, m"] < 0.5
    assert figures["scale"] == pytest.approx(0.07, abs=0.02)
    assert {landmark["number"] for landmark in json.loads((output / "landmarks.json").read_text())} == {1, 4, 6}


def test_trilateration_is_exact_without_noise() -> None:
    places = np.array([[0.0, 0.0], [5.0, 1.0], [2.0, -4.0], [7.0, 6.0]])
    ranges = np.hypot(*(places - [3.0, 8.0]).T)
    np.testing.assert_allclose(trilateration(places, ranges), [3.0, 8.0], atol=1e-9)


def test_a_scale_that_is_none_is_refused(tmp_path: Path) -> None:
    path, _ = park(tmp_path)
    result = landmarks(path, "--output", tmp_path / "out", "--odometry-scale", "0")
    assert result.exit_code == 2
    assert "--odometry-scale 0: expected a number > 0" in result.stderr
