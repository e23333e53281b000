"""The middle of long recordings of traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from data_tools.datasets.recorded_traffic import RecordedTraffic, Stretches
from tests.data_tools.datasets.test_overlapping import traffic


@dataclass(frozen=True)
class One:
    names = ("one",)

    def recording(self, name: str) -> RecordedTraffic:
        return traffic(name, seed=1, moments=101)


@pytest.mark.parametrize(("longest", "moments", "first"), [(4.0, 41, 30), (10.0, 101, 0), (np.inf, 101, 0)])
def test_the_middle_of_a_recording(longest: float, moments: int, first: int) -> None:
    whole, stretch = One().recording("one"), Stretches(One(), longest)
    assert stretch.names == ("one",)
    found = stretch.recording("one")
    assert len(found) == moments
    assert (found.position == whole.position[first : first + moments]).all()
