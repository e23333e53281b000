"""Which gaps there are, and how a run is judged on them."""

from __future__ import annotations

import pytest

from benchmarks.gap_runs import ExtrapolatedRun, Links, judgement, links, real_gaps
from pipelines.learning.gaps import CAP, JudgedRun
from saga_fg.learning.gaps import Gap
from tests.pipelines.sampled_gaps import (
    HIDDEN,
    SEEN,
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
    outcome = judgement(judged, gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, True, True)
    assert outcome.error == pytest.approx(1.5)
    assert outcome.at == pytest.approx({1.0: 1.5, 2.0: 1.5})
    assert links(judged) == Links(right=1)


def test_a_track_that_ends_is_lost_and_costs_the_cap() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(6, 16)), "8": without(straight(), range(9))}
    judged = JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN}))
    outcome = judgement(judged, gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, False, False)
    assert outcome.error == pytest.approx(3 * CAP / 4), "still there at the first of four moments"
    assert links(judged) == Links()
    nobody = judgement(JudgedRun(drawn, tracks({}, {})), gap)
    assert (nobody.held, nobody.kept, nobody.reported, nobody.error) == (False, False, False, CAP)


def test_a_track_that_stays_beside_the_one_that_takes_the_detections_keeps_no_identity() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": straight(), "8": without(straight(0.3), range(9))}
    old = [k < 5 for k in range(16)]
    assert not judgement(JudgedRun(drawn, tracks(places, {"7": old, "8": SEEN})), gap).kept


def test_an_identity_may_be_handed_over_within_half_a_second() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(9, 10)), "8": without(straight(), [*range(9), *range(10, 16)])}
    assert judgement(JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN})), gap).kept
    later = {"7": without(straight(), range(9, 12)), "8": without(straight(), [*range(9), *range(12, 16)])}
    assert not judgement(JudgedRun(drawn, tracks(later, {"7": SEEN, "8": SEEN})), gap).kept


def test_a_track_that_goes_on_with_another_object_is_a_false_link() -> None:
    other = without(straight(4.0), range(9))
    labels = {"a": without(straight(), range(9, 16)), "b": other}
    drawn = labelled(labels, {"a": without(straight(), range(5, 16)), "b": other})
    place = [*straight()[:9], *straight(4.0)[9:]]
    judged = JudgedRun(drawn, tracks({"7": place}, {"7": SEEN}))
    assert links(judged) == Links(false=1)
    clutter = JudgedRun(drawn, tracks({"7": [*straight()[:9], *straight(40.0)[9:]]}, {"7": SEEN}))
    assert links(clutter) == Links(unknown=1)


def test_a_tracker_that_reports_nothing_unseen_is_extrapolated() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    found = tracks({"7": without(straight(), HIDDEN)}, {"7": SEEN})
    assert judgement(ExtrapolatedRun(drawn, found), gap).error == pytest.approx(0.0, abs=1e-9)
    assert judgement(JudgedRun(drawn, found), gap).error == CAP
