"""The middle of long recordings of traffic."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.recordings.traffic import Recordings
from tests.benchmarks.recordings.test_overlapping import traffic


@pytest.mark.parametrize(("longest", "moments", "first"), [(4.0, 41, 30), (10.0, 101, 0), (np.inf, 101, 0)])
def test_the_middle_of_a_recording(longest: float, moments: int, first: int) -> None:
    one = Recordings(("one",), lambda name: traffic(name, seed=1, moments=101))
    whole, middle = one.read("one"), one.middle(longest)
    assert middle.names == ("one",)
    found = middle.read("one")
    assert len(found) == moments
    assert (found.vehicles.position == whole.vehicles.position[first : first + moments]).all()
    assert found.vehicles.time[0] == 0.0
