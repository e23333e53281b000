"""NGSIM windows and OpenACC platoons as recorded: where vehicles drive, who stops, and platoons in order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings.ngsim import ngsim_windows
from benchmarks.recordings.openacc import openacc_platoons
from benchmarks.recordings.sensed import sensed_scene
from benchmarks.recordings.traffic import RecordedTraffic, Recordings
from saga_fg.numerics.geometry import feet, on_it


@pytest.fixture(scope="module")
def ngsim(recordings: Path) -> Recordings:
    if not (recordings / "ngsim").is_dir():
        pytest.skip("no NGSIM windows among the recordings")
    return ngsim_windows(recordings / "ngsim")


@pytest.fixture(scope="module")
def openacc(recordings: Path) -> Recordings:
    pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
    if not (recordings / "openacc").is_dir():
        pytest.skip("no OpenACC platoons among the recordings")
    return openacc_platoons(recordings / "openacc")


def test_vehicles_drive_in_the_lanes_of_the_map(ngsim: Recordings) -> None:
    traffic = ngsim.read("USA_Lanker-2_6_T-1")
    assert traffic.road_map is not None
    position, yaw = traffic.vehicles.position[traffic.vehicles.present], traffic.vehicles.yaw[traffic.vehicles.present]
    inside = np.zeros(len(position), dtype=bool)
    for lane in traffic.road_map.lanes:
        centre = np.array(lane.centre)
        foot = feet(centre, position)
        along = np.cos(np.arctan2(*foot.direction.T[::-1]) - yaw) > 0.7
        inside |= along & on_it(centre, foot.s) & (np.abs(foot.e) < lane.width / 2)
    assert inside.mean() > 0.95


def standing_at_lines(traffic: RecordedTraffic) -> dict[str, list[bool]]:
    """Whether vehicles within 12 m before a line stand, by the colour that is shown."""
    found: dict[str, list[bool]] = {"red": [], "amber": [], "green": []}
    assert traffic.road_map is not None
    for line in traffic.road_map.stop_lines:
        (left, right), shown = line.ends, traffic.colours[line.light]
        ahead, width = np.array([np.cos(line.heading), np.sin(line.heading)]), np.hypot(*(line.ends[1] - line.ends[0]))
        across = (traffic.vehicles.position - left) @ ((right - left) / width)
        way = (left - traffic.vehicles.position) @ ahead - traffic.vehicles.size[:, 0] / 2
        comes = traffic.vehicles.present & (np.abs(way - 5.5) < 6.5) & (np.abs(across - width / 2) < width / 2)
        comes &= np.cos(traffic.vehicles.yaw - line.heading) > 0.8
        for k, n in zip(*np.nonzero(comes), strict=True):
            found[str(shown[k])].append(bool(np.hypot(*traffic.vehicles.velocity[k, n]) < 0.5))
    return found


def test_vehicles_stand_at_red_and_go_at_green(ngsim: Recordings) -> None:
    stand: dict[str, list[bool]] = {"red": [], "amber": [], "green": []}
    for name in ngsim.names:
        if "Lanker" in name:
            for colour, found in standing_at_lines(ngsim.read(name)).items():
                stand[colour] += found
    assert min(len(stand["red"]), len(stand["green"])) > 1000
    assert np.mean(stand["red"]) > 0.85
    assert np.mean(stand["green"]) < 0.2


def test_dense_traffic_hides_vehicles_from_a_mast(ngsim: Recordings) -> None:
    scene = sensed_scene(ngsim.read("USA_Lanker-1_2_T-1"), "mast", None, seed=0)
    assert scene.ground_truth is not None
    visible = np.concatenate([truth.visible for truth in scene.ground_truth])
    assert 0.2 < visible.mean() < 0.95
    counts = [len(frame) for frame in scene.frames]
    assert min(counts) > 5
    assert scene.frames[0].road_map is not None


def test_platoons_keep_their_order_and_plausible_gaps(openacc: Recordings) -> None:
    assert len(openacc.names) == 37
    traffic = openacc.read("short_setting-dynamic_part4")
    ids = traffic.vehicles.id.astype(int)
    assert sorted(ids.tolist()) == list(range(1, 12))
    order = np.argsort(ids)
    position, yaw, length = (
        traffic.vehicles.position[:, order],
        traffic.vehicles.yaw[:, order],
        traffic.vehicles.size[order, 0],
    )
    assert (length > 3).all()
    assert (length < 6).all()
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)[:, 1:]
    offset = position[:, :-1] - position[:, 1:]
    assert (np.einsum("kni,kni->kn", offset, ahead) > 0).mean() > 0.98  # the track is a circle
    gap = np.hypot(*np.moveaxis(offset, -1, 0)) - (length[1:] + length[:-1]) / 2
    assert 5 < np.median(gap) < 25
    moved = np.hypot(*np.moveaxis(np.diff(position, axis=0), -1, 0)) / 0.1
    both = traffic.vehicles.present[1:, order] & traffic.vehicles.present[:-1, order]
    speed = np.hypot(*np.moveaxis(traffic.vehicles.velocity[1:, order], -1, 0))
    assert np.quantile(np.abs(moved - speed)[both], 0.99) < 1.5
