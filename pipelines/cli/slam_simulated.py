"""`saga-fg slam simulated`: a simulated street, where the truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.console import working
from pipelines.cli.options import Config, Lag, Online, Verbose, online_window

if TYPE_CHECKING:
    from saga_fg.slam.joint import Observations
    from saga_fg.types.frame import Frame


def simulated(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the scene and of the odometry's errors.")] = 0,
    duration: Annotated[float, typer.Option("--duration", min=2.0, help="Length of the drive, s.")] = 20.0,
    online: Online = False,
    lag: Lag = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Drive down a simulated street with poor odometry; the path and all objects are estimated in one graph.

    With --online once more, frame by frame, in a window of the last seconds.

    Writes the paths (TUM, KITTI), the covariances of the poses, the tracks of the objects (tracks.csv), landmarks
    (landmarks.json), errors.json and a picture from above (above.png).

    \b
    Example:
      saga-fg slam simulated --seed 3 --output street
      saga-fg slam simulated --seed 3 --online --lag 2 --output street
    """
    from dataclasses import replace

    from data_tools.files.atomic_files import check_writable_folder
    from data_tools.simulator import simulate_scene
    from pipelines.slam.configuration import load_slam_config
    from pipelines.slam.joint import run_joint, street
    from pipelines.slam.results import write_joint

    window = online_window(online, lag)
    check_writable_folder(output)
    settings = load_slam_config("simulated", config)
    slam, detectors = settings.slam, settings.slam.new_detectors()

    def landmarks(frames: Sequence[Frame]) -> Observations:
        return [[seen for detector in detectors for seen in detector.observations(frame)] for frame in frames]

    scene = simulate_scene(replace(street(), duration=duration), seed)
    with working("estimating"):
        run = run_joint(scene, settings, slam.joint, "lidar", seed, landmarks, window, slam.new_providers)
        write_joint(output, run)
    errors = run.errors()
    joint = errors["joint"]
    typer.echo(f"{output}: {joint.poses} poses over {joint.path_length:.0f} m")
    typer.echo(f"ATE: odometry {errors['odometry'].ate:.3f} m, joint {joint.ate:.3f} m")
    for name in [name for name in errors if name not in ("odometry", "joint")]:
        typer.echo(f"{name} (lag {window:g} s): ATE {errors[name].ate:.3f} m")
