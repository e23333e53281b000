"""Factor providers of users' own in `saga-fg smooth`: named in the configuration, or given from Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.datasets.detection_files import read_detections, read_scenes_in_parts, read_tracks
from pipelines.cli import app
from pipelines.smoothing import ChunkSettings, load_smooth_config, smooth_scene, smooth_stream
from tests.pipelines.command import done

MODULE = """
from functools import partial

import numpy as np

from factors import ResidualFactors
from saga_fg.graph import OBJECT, Additions


def crowded(origin, x):  # a wall at y = 4
    return np.logaddexp(0.0, (x[:, 1:2] + origin[1] - 3.5) / 0.1)


class Wall:
    name = "wall"

    def factors(self, view):
        rows = [[one.key] for one in view.now(OBJECT).values() if one.label == "pedestrian"]
        return Additions(factors=[ResidualFactors(rows, (4,), partial(crowded, view.origin), 0.01 * np.eye(1))])


class Broken:
    name = "broken"

    def factors(self, view):
        raise ValueError("no wall is known")
"""


@pytest.fixture
def walkers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pedestrian on his way to a wall, beside the module that knows of it."""
    (tmp_path / "walls_of_this_test.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    rng = np.random.default_rng(0)
    rows = [
        f"drive,{0.25 * k},pedestrian,{0.1 * k + rng.normal(0, 0.05):.4f},{2 + 0.02 * k + rng.normal(0, 0.05):.4f},0.9"
        for k in range(72)
    ]
    path = tmp_path / "walkers.csv"
    path.write_text("\n".join(["scene,timestamp,label,x,y,score", *rows]) + "\n")
    return path


def configuration(folder: Path, provider: str) -> Path:
    path = folder / f"{provider}.yaml"
    path.write_text(f"smoothing:\n  providers: ['walls_of_this_test:{provider}']\n")
    return path


def test_a_wall_of_the_configuration_moves_the_labels(walkers: Path) -> None:
    arguments = ["smooth", "file", str(walkers), "-o"]
    for more in ([], ["--config", str(configuration(walkers.parent, "Wall"))]):
        done(*arguments, walkers.parent / f"labels{len(more)}", *more)
    plain, walled = (
        read_tracks(walkers.parent / folder / "labels.csv").boxes.position for folder in ("labels0", "labels2")
    )
    assert len(plain) == len(walled) == 72
    assert np.allclose(plain[0], walled[0], atol=1e-3)
    assert walled[-1, 1] < plain[-1, 1] - 0.02

    run = CliRunner().invoke(
        app, [*arguments, str(walkers.parent / "broken"), "--config", str(configuration(walkers.parent, "Broken"))]
    )
    assert run.exit_code != 0
    assert "provider broken: no wall is known" in run.output


def test_in_chunks_and_from_python_it_is_the_same(walkers: Path) -> None:
    from walls_of_this_test import Wall  # type: ignore[import-not-found]

    config = load_smooth_config("file", configuration(walkers.parent, "Wall"))
    parts = read_scenes_in_parts(walkers, 20)
    (run,) = smooth_stream(parts, config, walkers.parent, chunks=ChunkSettings(length=5.0, margin=5.0))
    streamed = run.tracks
    scene = read_detections(walkers).scene("drive")
    for whole in (smooth_scene(scene, config), smooth_scene(scene, load_smooth_config("file"), providers=[Wall()])):
        assert len(list(walkers.parent.glob("000000/*.npz"))) > 1
        assert len(streamed) == len(whole.tracks)
        for mine, theirs in zip(streamed, whole.tracks, strict=True):
            assert mine.id.tolist() == theirs.id.tolist()
            np.testing.assert_allclose(mine.boxes.position, theirs.boxes.position, atol=2e-3)
