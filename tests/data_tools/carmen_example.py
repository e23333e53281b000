"""Logs of planar lasers in the text format of CARMEN."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_tools.laser import LaserLog

NO_RETURN = 81.91  # m, what a laser says where it hits nothing


def write_carmen(path: Path, log: LaserLog) -> None:
    """Write a log as FLASER records."""
    lines = ["# message formats defined: PARAM SYNC ODOM FLASER"]
    for time, ranges, pose in zip(log.time, np.nan_to_num(log.ranges, nan=NO_RETURN), log.odometry, strict=True):
        at = " ".join(f"{value:.6f}" for value in pose)
        readings = " ".join(f"{r:.3f}" for r in ranges)
        lines.append(f"FLASER {len(ranges)} {readings} {at} {at} {time:.6f} nohost {time:.6f}")
    path.write_text("\n".join(lines) + "\n")
