"""Tables of tracks."""

import numpy as np
import pytest

from saga_fg import Boxes, InputError, Tracks
from saga_fg.types.track import KNOWN_SPEED_DEVIATION, known_velocities


def table(n=2, **columns):
    good = {
        "timestamp": 1.0,
        "id": np.arange(n) + 7,
        "boxes": Boxes.of(["car"] * n, np.arange(3.0 * n).reshape(n, 3), velocity=np.ones((n, 2))),
        "score": np.linspace(0, 1, n),
        "position_covariance": np.stack([k * np.eye(2) for k in range(n)]) if n else np.empty((0, 2, 2)),
        "velocity_covariance": np.ones((n, 2, 2)),
        "coasting": np.zeros(n),
    }
    return Tracks(**(good | columns))


def test_velocities_of_a_large_deviation_are_unknown():
    P = np.array([s**2 * np.eye(2) for s in (0.1, KNOWN_SPEED_DEVIATION, 2.1, np.nan)])
    known = known_velocities(np.ones((4, 2)), P)
    assert np.isfinite(known).all(axis=1).tolist() == [True, True, False, True]


def test_rows_of_the_table():
    tracks = table()
    assert len(tracks) == 2
    second = list(tracks)[1]
    assert (second.id, second.label, second.position, second.score) == (8, "car", (3.0, 4.0, 5.0), 1.0)
    assert second.velocity == (1.0, 1.0)
    assert second.position_covariance.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert type(second.id) is int
    assert type(second.coasting) is float


def test_selected_rows_keep_time_and_columns():
    tracks = table(3)
    for rows in ([2, 0], np.array([2, 0])):
        assert tracks.select(rows).id.tolist() == [9, 7]
    chosen = tracks.select(np.array([False, True, False]))
    assert chosen.timestamp == 1.0
    assert chosen.id.tolist() == [8]
    assert chosen.position_covariance[0].tolist() == np.eye(2).tolist()
    assert len(tracks.select([])) == 0
    assert tracks.select(slice(1, None)).id.tolist() == [8, 9]


def test_no_tracks():
    empty = Tracks.empty(3.0)
    assert (len(empty), empty.timestamp, list(empty)) == (0, 3.0, [])
    assert len(table(0)) == 0


def test_wrong_columns_are_named(subtests):
    for columns, message in [
        ({"id": [1, 1]}, "id: expected unique ids, 1 occurs more than once"),
        ({"id": [1]}, "id: expected 2 entries, got 1"),
        ({"id": [0.5, 1.5]}, "id: expected a list of integers"),
        ({"score": [0.5, np.nan]}, r"score\[1\]: expected a finite number"),
        ({"score": [0.5]}, r"score: expected shape \(2,\)"),
        ({"position_covariance": np.ones((2, 3, 3))}, r"position_covariance: expected shape \(2, 2, 2\)"),
        ({"velocity_covariance": np.full((2, 2, 2), np.inf)}, r"velocity_covariance\[0, 0, 0\]: expected a finite"),
        ({"coasting": [0.0]}, r"coasting: expected shape \(2,\)"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            table(**columns)


def test_columns_are_read_only():
    assert not table().score.flags.writeable
    assert not table().position_covariance.flags.writeable
