"""The reader of NGSIM windows, on files written by hand."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings.ngsim import ngsim_windows
from benchmarks.recordings.sensed import true_scene
from benchmarks.recordings.sources import TrafficScenes
from saga_fg.errors import InputError
from tests.benchmarks.recordings.ngsim_example import HEADER, crossing, rows, write_ngsim


def test_rows_become_states_on_a_common_grid(tmp_path: Path) -> None:
    windows = ngsim_windows(write_ngsim(tmp_path, rows() + rows("B"), {"A": crossing(), "B": crossing()}))
    assert windows.names == ("A", "B")
    traffic = windows.read("A")
    assert traffic.vehicles.id.tolist() == ["1", "2", "3"]
    assert traffic.vehicles.label.tolist() == ["car", "car", "truck"]  # of its length
    np.testing.assert_allclose(traffic.vehicles.time, 0.1 * np.arange(12))
    np.testing.assert_allclose(traffic.vehicles.position[7], [[-33.0, 4.0], [-3.0, 0.0], [-26.5, 0.0]])
    np.testing.assert_allclose(traffic.vehicles.velocity[7], [[10.0, 0.0], [0.0, 0.0], [5.0, 0.0]])
    assert traffic.vehicles.present[:, 2].tolist() == [False] * 5 + [True] * 7
    np.testing.assert_allclose(
        traffic.vehicles.position[0, 2], traffic.vehicles.position[5, 2]
    )  # of the nearest moment where absent
    assert (traffic.vehicles.size[:, 2] > 1).all()


def test_columns_come_in_any_order_and_without_compression(tmp_path: Path) -> None:
    names = HEADER.split(",")
    turned = [",".join(row.split(",")[::-1]) for row in rows()]
    (tmp_path / "windows.csv").write_text("\n".join([",".join(names[::-1]), *turned]))
    traffic = ngsim_windows(tmp_path, "none").read("A")
    np.testing.assert_allclose(traffic.vehicles.position[3, 0], [-37.0, 4.0])
    assert traffic.road_map is None


def test_steps_that_start_late_keep_the_phase_of_the_lights(tmp_path: Path) -> None:
    late = [row.replace(f",{k},car", f",{k + 10},car") for k in range(12) for row in rows() if f",{k},car" in row]
    colours = ngsim_windows(write_ngsim(tmp_path, late, {"A": crossing()})).read("A").colours["light-7"]
    assert colours.tolist() == ["green"] * 3 + ["amber"] * 5 + ["red"] * 4


def test_what_is_wrong_in_a_row_is_named(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for line, message in [
        ("X,A,4,0,car,1,2,0,1,,4.5", r"windows.csv.gz: line 33: expected 12 columns, got 11"),
        ("X,A,4,0,car,east,2,0,1,,4.5,2", r"line 33: x: expected a finite number, got 'east'"),
        ("X,A,4,0.5,car,1,2,0,1,,4.5,2", r"line 33: step: expected a whole number from 0"),
        ("X,A,4,0,car,1,2,0,-1,,4.5,2", r"line 33: speed: expected a number of at least 0, got -1"),
        ("X,A,4,0,car,1,2,0,1,,0,2", r"line 33: length: expected a number above 0, got 0"),
        ("X,A,,0,car,1,2,0,1,,4,2", r"line 33: scenario, id, type: expected a value"),
        ("X,A,1,0,car,1,2,0,1,,4.5,2", r"A: vehicle 1: expected one state at 0.0 s, there are more"),
    ]:
        with subtests.test(message):
            write_ngsim(tmp_path, [*rows(), line], {"A": crossing()})
            with pytest.raises(InputError, match=message):
                ngsim_windows(tmp_path).read("A")


def test_wrong_columns_empty_files_and_missing_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected windows.csv.gz or windows.csv, there is neither"):
        ngsim_windows(tmp_path)
    write_ngsim(tmp_path, rows(), header=HEADER.replace("yaw", "heading"))
    with pytest.raises(InputError, match=r"windows.csv.gz: yaw: expected this column, the file has site, scenario"):
        ngsim_windows(tmp_path)
    write_ngsim(tmp_path, [])
    with pytest.raises(InputError, match=r"windows.csv.gz: expected rows, there are none"):
        ngsim_windows(tmp_path)
    (tmp_path / "windows.csv.gz").write_bytes(gzip.compress(b""))
    with pytest.raises(InputError, match=r"scenario: expected this column, the file has none"):
        ngsim_windows(tmp_path)
    (tmp_path / "windows.csv.gz").write_bytes(b"not compressed")
    with pytest.raises(InputError, match=r"windows.csv.gz: expected text in UTF-8, compressed by gzip"):
        ngsim_windows(tmp_path)


def test_a_window_of_one_moment_and_an_unknown_one_are_errors(tmp_path: Path) -> None:
    windows = ngsim_windows(write_ngsim(tmp_path, rows(steps=1), {"A": crossing()}))
    with pytest.raises(InputError, match=r"windows.csv.gz: A: expected at least two moments, got 1"):
        windows.read("A")
    with pytest.raises(InputError, match=r"unknown recording 'B'"):
        TrafficScenes(windows, true_scene).scene("B")


def test_a_window_without_a_map_is_an_error_that_says_how_to_go_without(tmp_path: Path) -> None:
    write_ngsim(tmp_path, rows(), {"B": crossing()})
    with pytest.raises(InputError, match=r"maps.json.gz: A: expected a map, there is none; --road none goes without"):
        ngsim_windows(tmp_path).read("A")
    assert ngsim_windows(tmp_path, "none").read("A").road_map is None
    (tmp_path / "maps.json.gz").unlink()
    with pytest.raises(InputError, match=r"expected maps.json.gz or maps.json, there is neither; --road none"):
        ngsim_windows(tmp_path).read("A")
    (tmp_path / "maps.json").write_text("{")
    with pytest.raises(InputError, match=r"maps.json: expected JSON"):
        ngsim_windows(tmp_path).read("A")
