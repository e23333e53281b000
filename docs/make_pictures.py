"""Makes the pictures of the documentation; needs a Chromium for the page: PYTHONPATH=. python docs/make_pictures.py."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import threading
from functools import partial
from pathlib import Path

import numpy as np
from birds_eye_picture import write_birds_eye_picture
from concept_pictures import write_concept_pictures
from crossing_picture import write_crossing_picture
from crowd_picture import write_crowd_picture
from gap_picture import write_gap_picture
from heterogeneous_picture import write_heterogeneous_picture
from slam_loops_picture import write_loops_picture

from benchmarks.joint import degraded_drive, street
from benchmarks.scans import SimulatedScans, laser_drive
from data_tools.figures import paths_from_above, png
from data_tools.files.file_access import write_bytes
from data_tools.simulator import simulate_scene
from pipelines.config import load_config
from pipelines.demo import run_demo
from pipelines.review import CORRECTIONS, ReviewServer, ReviewSession, read_label_run
from pipelines.slam.laser_slam import laser_slam
from pipelines.slam.lidar_slam import lidar_slam, path_tracker
from pipelines.slam.results import confirmed_paths, write_laser_slam, write_lidar_slam
from saga_fg.slam.joint import JointSettings, estimate_jointly

HERE = Path(__file__).parent


def screenshot(address: str, picture: Path, width: int, height: int) -> None:
    """A picture of the upper left corner of a page, taken in a browser without a window."""
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    assert chromium is not None, "no Chromium on the path, nor in the variable CHROMIUM"
    with tempfile.TemporaryDirectory() as profile:
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=5000"]
        options += [f"--user-data-dir={profile}", f"--window-size={width},{height}", f"--screenshot={picture}"]
        subprocess.run([chromium, *options, address], check=True, capture_output=True)


def write_review_picture(picture: Path, folder: Path) -> None:
    """The page of a review of simulated traffic, with a box that was put right."""
    smooth = "from pipelines.cli.main import main; main()"
    options = ["smooth", "simulated", "--scenes", "1", "--seed", "3", "--output", str(folder)]
    subprocess.run([sys.executable, "-c", smooth, *options], check=True)
    run = read_label_run(folder)
    session = ReviewSession(folder, run, folder / CORRECTIONS)
    with run.open() as (_, dataset):
        start = float(dataset.scene("scene-0001").timestamps[0])
    state = session.state("scene-0001")
    row = next(row for row in state["rows"] if row["why"] == "box")
    place = {"time": row["timestamp"], "x": row["x"], "y": row["y"]}
    box = {"x": row["x"] + 0.8, "y": row["y"] + 0.5}
    session.correct(state["version"], {"what": "box", "at": place, "box": box, "scene": "scene-0001", "who": "anna"})
    with ReviewServer(session) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        time = row["timestamp"] - start
        screenshot(f"{server.url}#t={time}&id={row['id']}", picture, 1300, 780)
        server.shutdown()


def main() -> None:
    """All pictures; those of recordings where the variable SAGA_FG_DATA names their folder."""
    write_concept_pictures(HERE)
    write_crowd_picture(HERE / "crowd.png")
    write_crossing_picture(HERE / "crossing.png")
    write_heterogeneous_picture(HERE)
    write_loops_picture(HERE)
    if data := os.environ.get("SAGA_FG_DATA"):
        write_gap_picture(HERE / "gap.png", Path(data))
    with tempfile.TemporaryDirectory() as folder:
        demo = Path(folder) / "demo"
        comparison = run_demo(demo, load_config("simulated"))
        write_birds_eye_picture(HERE / "birds_eye.png", comparison, load_config("simulated"))
        screenshot((demo / "index.html").resolve().as_uri(), HERE / "report.png", 1300, 920)
        write_review_picture(HERE / "review.png", Path(folder) / "labels")
        frames, truth, odometry = degraded_drive(simulate_scene(street(), 0), JointSettings(), "lidar", 0)
        start, config = truth.world_T_ego[0], load_config("simulated")
        joint = estimate_jointly(frames, odometry, partial(path_tracker, config), JointSettings(), start)
        paths = {"truth": truth.positions, "odometry": odometry.path(start)[:, :3, 3]}
        paths["joint"] = joint.world_T_ego[:, :3, 3]
        last = np.array([path[-1] for path in confirmed_paths(joint).values()])
        write_bytes(HERE / "joint_above.png", png(paths_from_above(paths, {"objects": last})))
        scans = SimulatedScans(seed=0, count=40)
        write_lidar_slam(Path(folder) / "slam", lidar_slam(scans), scans)
        shutil.copy(Path(folder) / "slam" / "above.png", HERE / "slam_above.png")
        log, _ = laser_drive(seed=0)
        write_laser_slam(Path(folder) / "laser", log, laser_slam(log), 30.0, 0.0)
        shutil.copy(Path(folder) / "laser" / "map.png", HERE / "laser_map.png")


if __name__ == "__main__":
    main()
