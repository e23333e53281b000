"""The reader of OpenACC platoons, on files written by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.recordings.openacc import openacc_platoons
from benchmarks.recordings.traffic import Recordings
from saga_fg.errors import InputError

pa = pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="the extra [parquet] is not installed")

K, GAP = 40, 10.0


def platoon(lengths: tuple[float, ...] = (5.0, 4.2, 5.0)) -> dict[str, Any]:
    """Cars at 10 m/s to the north, with 10 m between bumpers."""
    columns: dict[str, list[Any]] = {
        name: [] for name in ("setting", "run", "t", "veh", "speed", "east", "north", "gap_to_next")
    }
    front = 0.0
    for number, length in enumerate(lengths, start=1):
        for k in range(K):
            last = number == len(lengths)
            gap = float("nan") if last else GAP
            row = ("short gap", "part1", 100 + 0.1 * k, number, 10.0, 3.0, front - length / 2 + k, gap)
            for column, value in zip(columns.values(), row, strict=True):
                column.append(value)
        front -= length + GAP
    return columns


def write(root: Path, columns: dict[str, Any]) -> Recordings:
    parquet.write_table(pa.table(columns), root / "platoons.parquet")
    return openacc_platoons(root)


def test_a_platoon_drives_in_order_with_its_gaps(tmp_path):
    platoons = write(tmp_path, platoon())
    assert platoons.names == ("short_gap-part1",)
    traffic = platoons.read("short_gap-part1")
    assert traffic.vehicles.id.tolist() == ["1", "2", "3"]
    assert len(traffic) == K
    np.testing.assert_allclose(traffic.vehicles.yaw, np.pi / 2)
    np.testing.assert_allclose(traffic.vehicles.velocity[5], [[0.0, 10.0]] * 3, atol=1e-9)
    centres = traffic.vehicles.position[0, :, 1]
    assert (np.diff(centres) < 0).all()
    half = (traffic.vehicles.size[1:, 0] + traffic.vehicles.size[:-1, 0]) / 2
    np.testing.assert_allclose(-np.diff(centres) - half, GAP, atol=0.1)
    assert traffic.road_map is None


def test_moments_without_a_position_and_jumps_are_left_out(tmp_path):
    columns = platoon()
    columns["east"][3] = None
    columns["speed"][5] = float("nan")
    columns["east"][20] += 2.0  # there and back
    present = write(tmp_path, columns).read("short_gap-part1").vehicles.present
    assert np.flatnonzero(~present[:, 0]).tolist() == [3, 5, 19, 20, 21]
    assert present[:, 1:].all()


def test_a_car_that_stands_keeps_the_heading_that_it_had(tmp_path):
    columns = platoon((5.0,))
    north = np.array(columns["north"])
    north[20:] = north[20]
    still = [10.0 if k <= 20 else 0.0 for k in range(K)]
    traffic = write(tmp_path, {**columns, "north": north, "speed": still}).read("short_gap-part1")
    np.testing.assert_allclose(traffic.vehicles.yaw, np.pi / 2)
    np.testing.assert_allclose(traffic.vehicles.velocity[30], 0.0)


def test_what_is_wrong_in_the_file_is_named(tmp_path, subtests):
    for changes, message in [
        ({"gap_to_next": None}, r"platoons.parquet: gap_to_next: expected this column, the file has setting, run"),
        ({"speed": ["fast"] * K}, r"speed: expected numbers, got object"),
        ({"veh": [1.5] * K}, r"veh: expected whole numbers, got float64"),
        ({"run": [None] * K}, r"run: expected a value in every row"),
        ({"t": [0.13 * k for k in range(K)]}, r"short_gap-part1: t: expected times every 0.1 s, got 0.13"),
        ({"t": [0.0] * K}, r"short_gap-part1: expected at least two moments, got 1"),
        ({"t": [0.0, 0.1] * (K // 2)}, r"vehicle 1: expected one state at 0.0 s, there are more"),
        ({"east": [1e12] * K}, r"east, north: expected numbers within 1e\+09"),
        ({"east": [float("nan")] * K}, r"expected positions and speeds, there are none"),
    ]:
        with subtests.test(message):
            columns = {name: column for name, column in (platoon((5.0,)) | changes).items() if column is not None}
            with pytest.raises(InputError, match=message):
                write(tmp_path, columns).read("short_gap-part1")


def test_no_file_and_an_empty_one_are_errors(tmp_path):
    with pytest.raises(InputError, match=r"platoons.parquet: cannot be read"):
        openacc_platoons(tmp_path)
    (tmp_path / "platoons.parquet").write_bytes(b"")
    with pytest.raises(InputError, match=r"expected a readable Parquet file"):
        openacc_platoons(tmp_path)
    schema = pa.schema([(n, pa.string() if n in ("setting", "run") else pa.float64()) for n in platoon()])
    parquet.write_table(schema.set(3, pa.field("veh", pa.int64())).empty_table(), tmp_path / "platoons.parquet")
    with pytest.raises(InputError, match=r"expected rows, there are none"):
        openacc_platoons(tmp_path)
