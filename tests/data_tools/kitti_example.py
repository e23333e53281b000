"""A hand-written KITTI sequence: level, simple numbers, and yet every link of the chain different from identity.

The vehicle heads east from (49 N, 8 E), 1 m per frame, three frames. The LiDAR sits 1 m ahead of and 2 m above the IMU,
the camera in the LiDAR, looking ahead (camera x = -y, y = -z, z = x of the LiDAR). So in the first frame, heading east:

    world (x east, y north, z up) = (1 + z_camera, -x_camera, 2 - y_camera)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

CALIBRATION = {
    "P0:": [700, 0, 600, 0, 0, 700, 180, 0, 0, 0, 1, 0],
    "P2:": [700, 0, 600, 0, 0, 700, 180, 0, 0, 0, 1, 0],
    "R_rect": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    "Tr_velo_cam": [0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0],
    "Tr_imu_velo": [1, 0, 0, -1, 0, 1, 0, 0, 0, 0, 1, -2],
}

METRE = np.degrees(1 / (6378137.0 * np.cos(np.radians(49.0))))  # of longitude at 49 degrees north

LABELS = [
    # frame id type truncated occluded alpha bbox h w l x y z rotation_y
    "0 -1 DontCare -1 -1 -10 10 20 30 40 -1000 -1000 -1000 -10 -1 -1 -1",
    "0 4 Car 0 0 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.57079632679",
    "1 4 Car 0 1 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.57079632679",
    "2 4 Car 0 2 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.57079632679",
    "2 5 Person_sitting 1 3 0 700 150 720 250 1.2 0.5 0.6 -3 1.6 8 0",
]

DETECTIONS = {
    "Car": [
        "0,2,500,150,600,250,8.5,1.5,1.6,4,2,1.75,10,-1.57079632679,-1.5",
        "2,2,500,150,600,250,-0.5,1.5,1.6,4,2,1.75,10,-1.57079632679,-1.5",
    ],
    "Pedestrian": [],
    "Cyclist": ["2,3,700,150,720,250,1.25,1.7,0.6,1.8,-3,1.6,8,0,0.3"],
}


def oxts_line(east: float = 0.0, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> str:
    values = [49.0, 8.0 + east * METRE, 100.0, roll, pitch, yaw]
    return " ".join(repr(float(v)) for v in values + [0.0] * 24)


def calibration_text(**changes: list[float]) -> str:
    return "".join(f"{key} {' '.join(map(str, values))}\n" for key, values in (CALIBRATION | changes).items())


def write_sequence(root: Path, name: str = "0007") -> Path:
    """Write the sequence and its detections below `root`, which is returned."""
    training = root / "training"
    for folder in ("oxts", "calib", "label_02"):
        (training / folder).mkdir(parents=True, exist_ok=True)
    (training / "oxts" / f"{name}.txt").write_text("".join(oxts_line(k) + "\n" for k in range(3)))
    (training / "calib" / f"{name}.txt").write_text(calibration_text())
    (training / "label_02" / f"{name}.txt").write_text("\n".join(LABELS) + "\n")
    for kind, lines in DETECTIONS.items():
        (root / "found" / kind).mkdir(parents=True, exist_ok=True)
        (root / "found" / kind / f"{name}.txt").write_text("".join(line + "\n" for line in lines))
    return root
