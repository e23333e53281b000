"""DUT, cars and crowds on a campus without right of way: `PLACE_NN_veh.csv.gz` and `PLACE_NN_ped.csv.gz`, in;
recorded traffic, out.

    veh    id, frame, x_est, y_est, psi_est, vel_est    m, rad, m/s along psi; columns in any order, others are ignored
    ped    id, frame, x_est, y_est, vx_est, vy_est      m, m/s

A clip from above has 23.98 frames a second and coordinates of its own; states are interpolated to the common times.
Sizes are not recorded: all have usual ones. Source: Yang, Li, Redmill and Ozguner, Top-view Trajectories: A Pedestrian
Dataset of Vehicle-Crowd Interaction from Controlled Experiments and Crowded Campus, IEEE IV 2019.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.recordings.ngsim import named_columns, text_of
from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings, on_grid
from saga_fg.errors import InputError

RATE = 23.98  # frames a second
SIZES = {"veh": ("car", 4.5, 1.8), "ped": ("pedestrian", 0.6, 0.6)}
COLUMNS = {"veh": ("x_est", "y_est", "psi_est", "vel_est"), "ped": ("x_est", "y_est", "vx_est", "vy_est")}
_MAX_FRAME = 10_000_000  # frames
_LARGEST = 1e6  # m, rad, m/s


def dut_clips(root: Path) -> Recordings:
    """The clips in a folder. Raises `InputError` for a folder without any, and for a table that is not as above."""
    names = sorted(path.name.removesuffix("_veh.csv.gz") for path in root.glob("*_veh.csv.gz"))
    if not names:
        raise InputError(f"{root}: expected files PLACE_NN_veh.csv.gz, there is none")

    def read(name: str) -> RecordedTraffic:
        parts, sizes = [], {}
        for kind, columns in COLUMNS.items():
            table = named_columns(*text_of(root, (f"{name}_{kind}.csv.gz",)), ("id", "frame", *columns))
            time = table.integers(1, "frame", 0, _MAX_FRAME) / RATE
            states = table.numbers(slice(2, None), columns, _LARGEST)
            for one in np.unique(table.values[:, 0]).tolist():
                own = np.flatnonzero(table.values[:, 0] == one)
                own = own[np.argsort(time[own])]
                moment = np.arange(np.ceil(time[own[0]] / PERIOD), time[own[-1]] / PERIOD, dtype=np.int64)
                if kind == "veh":
                    states[own, 2] = np.unwrap(states[own, 2])
                at = np.stack([np.interp(moment * PERIOD, time[own], column) for column in states[own].T])
                x, y, velocity, yaw = at[0], at[1], at[2:], np.arctan2(at[3], at[2])
                if kind == "veh":
                    velocity, yaw = at[3] * np.stack([np.cos(at[2]), np.sin(at[2])]), at[2]
                sizes[f"{kind} {one}"] = SIZES[kind]
                parts.append((moment, np.full(len(moment), f"{kind} {one}"), np.stack([x, y], 1), velocity.T, yaw))
        k, who, place, velocity, yaw = (np.concatenate(column) for column in zip(*parts, strict=True))
        return on_grid(f"{root}: {name}", k - k.min(initial=_MAX_FRAME), who, (place, velocity, yaw), sizes)

    return Recordings(tuple(names), read)
