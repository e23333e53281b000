"""Made gaps hide one object among others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_tools.simulator import simulate_scene
from pipelines.config import load_config
from pipelines.learning.gaps import hidden
from saga_fg.learning.gaps import FOLLOWED, LENGTHS, SPACING, made_gaps
from saga_fg.learning.labelled_scene import LabelledScene
from tests.pipelines.sampled_gaps import SHORT


def test_made_gaps_hide_one_object_among_others() -> None:
    config = load_config("simulated")
    traffic = LabelledScene.from_scene(simulate_scene(SHORT, seed=4), config.sensors)
    gaps = made_gaps(traffic, passes=2, seed=0)
    assert gaps == made_gaps(traffic, passes=2, seed=0)
    assert {gap.run for gap in gaps} == {1, 2}
    assert {gap.length for gap in gaps} <= set(LENGTHS)
    still = made_gaps(traffic, passes=2, seed=0, chosen=lambda gap: not gap.moving)
    assert not any(gap.moving for gap in still)
    time = traffic.scene.timestamps
    for gap in gaps:
        assert time[gap.stop - 1] - time[gap.start] == pytest.approx(gap.length, abs=0.06)
        assert traffic.detected[[gap.start, gap.stop], gap.row].all()
        assert time[gap.start] >= FOLLOWED - 0.1
    first = [gap for gap in gaps if gap.run == 1]
    for a in first:
        for b in first:
            together = range(max(a.start, b.start), min(a.stop, b.stop) + 1)
            if a is not b and together:
                assert a.row != b.row
                apart = traffic.position[together[0], a.row] - traffic.position[together[0], b.row]
                assert np.hypot(*apart) >= SPACING
    frames = hidden(traffic, first)
    assert len(frames) == len(traffic.scene.frames)
    without_them = LabelledScene.from_scene(replace(traffic.scene, frames=frames), config.sensors)
    for gap in first:
        inside = slice(gap.start + 1, gap.stop)
        assert not without_them.detected[inside, gap.row].any()
        assert without_them.detected[[gap.start, gap.stop], gap.row].all()
    mine = [gap.row for gap in first]
    others = np.delete(traffic.detected, mine, axis=1)
    assert (np.delete(without_them.detected, mine, axis=1) == others).all()
