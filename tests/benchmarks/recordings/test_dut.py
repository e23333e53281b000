"""Cars and crowds of DUT: states at common times, and tables that are refused."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

from benchmarks.recordings.dut import RATE, dut_clips
from benchmarks.recordings.traffic import PERIOD
from saga_fg.errors import InputError

SPEED, SIDEWAYS = 3.0, 1.2  # m/s


def written(folder, cars=None, people=None):
    """A clip of a car that drives along y, its heading later a whole turn more, and of somebody who walks along x."""
    frames = range(24, 120)
    cars = cars or [f"0,{k},veh,1.0,{SPEED * k / RATE},{np.pi / 2 + 2 * np.pi * (k > 60)},{SPEED}" for k in frames]
    people = people or [f"0,{k},ped,{SIDEWAYS * k / RATE},5.0,{SIDEWAYS},0.0" for k in frames]
    heads = "id,frame,label,x_est,y_est,psi_est,vel_est", "id,frame,label,x_est,y_est,vx_est,vy_est"
    for kind, head, rows in (("veh", heads[0], cars), ("ped", heads[1], people)):
        text = "\n".join([head, *rows])
        (folder / f"yard_01_{kind}.csv.gz").write_bytes(gzip.compress(text.encode()))
    return dut_clips(folder)


def test_states_are_those_of_the_motion(tmp_path):
    clips = written(tmp_path)
    assert clips.names == ("yard_01",)
    traffic = clips.read("yard_01").vehicles
    car, person = (traffic.label.tolist().index(label) for label in ("car", "pedestrian"))
    assert traffic.present.all()
    along = traffic.position[:, car, 1] - traffic.position[0, car, 1]
    np.testing.assert_allclose(along, SPEED * PERIOD * np.arange(len(along)), atol=1e-6)
    np.testing.assert_allclose(traffic.velocity[:, car], np.tile([0.0, SPEED], (len(along), 1)), atol=1e-6)
    np.testing.assert_allclose(np.cos(traffic.yaw[:, car]), 0.0, atol=1e-6)
    np.testing.assert_allclose(traffic.velocity[:, person], np.tile([SIDEWAYS, 0.0], (len(along), 1)), atol=1e-6)


def test_wrong_tables_are_refused(tmp_path, subtests):
    for cars, message in (
        (["0,24,veh,1,2,0,fast"], "line 2: vel_est: expected a finite number, got 'fast'"),
        (["0,-1,veh,1,2,0,1"], "line 2: frame: expected a whole number from 0"),
        (["0,24,veh,1,2"], "line 2: expected 7 columns, got 5"),
    ):
        with subtests.test(message), pytest.raises(InputError, match="yard_01_veh") as found:
            written(tmp_path, cars).read("yard_01")
        assert message in str(found.value)
    with pytest.raises(InputError, match="expected files PLACE_NN_veh"):
        dut_clips(tmp_path / "nothing")
