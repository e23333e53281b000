"""Which gaps there are, and how a run is judged on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_tools.simulator import simulate_scene
from pipelines.config import load_config
from pipelines.learning.gaps import CAP, JudgedRun, Links, hidden
from saga_fg.learning.gaps import FOLLOWED, LENGTHS, SPACING, Gap, made_gaps, real_gaps
from saga_fg.learning.labelled_scene import LabelledScene
from tests.pipelines.sampled_gaps import (
    HIDDEN,
    SEEN,
    SHORT,
    TIMES,
    labelled,
    straight,
    tracks,
    without,
)


def test_a_real_gap_is_from_the_last_detection_to_the_next() -> None:
    found = real_gaps(labelled({"a": straight()}, {"a": without(straight(), HIDDEN)}))
    assert found == [Gap(0, 4, 9, 2.5, moving=True)]
    parked = [0.0] * len(TIMES)
    assert real_gaps(labelled({"a": parked}, {"a": without(parked, HIDDEN)})) == [Gap(0, 4, 9, 2.5, moving=False)]
    assert real_gaps(labelled({"a": parked}, {"a": without(parked, range(5, 16))})) == [], "it never returns"
    assert real_gaps(labelled({"a": parked}, {"a": without(parked, range(1, 15))})) == [], "longer than 6 s"
    once = [k != 1 and k not in HIDDEN for k in range(16)]
    assert (
        real_gaps(labelled({"a": parked}, {"a": [0.0 if s and k > 3 else None for k, s in enumerate(once)]})) == []
    ), "seen once before"


def test_a_duplicate_of_a_neighbour_is_no_detection_of_a_hidden_object() -> None:
    beside = straight(2.5)
    detections = {"a": without(straight(), HIDDEN), "b": beside, "ghost of b": straight(1.7)}
    assert [gap.row for gap in real_gaps(labelled({"a": straight(), "b": beside}, detections))] == [0]


def test_an_identity_is_kept_where_the_same_track_goes_on() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    off = [x + (1.5 if k in HIDDEN else 0.0) for k, x in enumerate(straight())]
    judged = JudgedRun(drawn, tracks({"7": off}, {"7": SEEN}))
    outcome = judged.outcome(gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, True, True)
    assert outcome.error == pytest.approx(1.5)
    assert outcome.at == pytest.approx({1.0: 1.5, 2.0: 1.5})
    assert judged.links() == Links(right=1)


def test_a_track_that_ends_is_lost_and_costs_the_cap() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(6, 16)), "8": without(straight(), range(9))}
    judged = JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN}))
    outcome = judged.outcome(gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, False, False)
    assert outcome.error == pytest.approx(3 * CAP / 4), "still there at the first of four moments"
    assert judged.links() == Links()
    nobody = JudgedRun(drawn, tracks({}, {})).outcome(gap)
    assert (nobody.held, nobody.kept, nobody.reported, nobody.error) == (False, False, False, CAP)


def test_a_track_that_stays_beside_the_one_that_takes_the_detections_keeps_no_identity() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": straight(), "8": without(straight(0.3), range(9))}
    old = [k < 5 for k in range(16)]
    assert not JudgedRun(drawn, tracks(places, {"7": old, "8": SEEN})).outcome(gap).kept


def test_an_identity_may_be_handed_over_within_half_a_second() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(9, 10)), "8": without(straight(), [*range(9), *range(10, 16)])}
    assert JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN})).outcome(gap).kept
    later = {"7": without(straight(), range(9, 12)), "8": without(straight(), [*range(9), *range(12, 16)])}
    assert not JudgedRun(drawn, tracks(later, {"7": SEEN, "8": SEEN})).outcome(gap).kept


def test_a_track_that_goes_on_with_another_object_is_a_false_link() -> None:
    other = without(straight(4.0), range(9))
    labels = {"a": without(straight(), range(9, 16)), "b": other}
    drawn = labelled(labels, {"a": without(straight(), range(5, 16)), "b": other})
    place = [*straight()[:9], *straight(4.0)[9:]]
    judged = JudgedRun(drawn, tracks({"7": place}, {"7": SEEN}))
    assert judged.links() == Links(false=1)
    clutter = JudgedRun(drawn, tracks({"7": [*straight()[:9], *straight(40.0)[9:]]}, {"7": SEEN}))
    assert clutter.links() == Links(unknown=1)


def test_a_tracker_that_reports_nothing_unseen_is_extrapolated() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    found = tracks({"7": without(straight(), HIDDEN)}, {"7": SEEN})
    assert JudgedRun(drawn, found, extrapolated=True).outcome(gap).error == pytest.approx(0.0, abs=1e-9)
    assert JudgedRun(drawn, found).outcome(gap).error == CAP


def test_made_gaps_hide_one_object_among_others() -> None:
    config = load_config("simulated")
    traffic = LabelledScene.of(simulate_scene(SHORT, seed=4), config.sensors)
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
    without_them = LabelledScene.of(replace(traffic.scene, frames=frames), config.sensors)
    for gap in first:
        inside = slice(gap.start + 1, gap.stop)
        assert not without_them.detected[inside, gap.row].any()
        assert without_them.detected[[gap.start, gap.stop], gap.row].all()
    mine = [gap.row for gap in first]
    others = np.delete(traffic.detected, mine, axis=1)
    assert (np.delete(without_them.detected, mine, axis=1) == others).all()
