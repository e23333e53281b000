"""Damage done to valid files, and the readers that must either read what is left or say in one error what is wrong.

`targets(folder)` makes a small valid input for every reader; `damaged` does to the bytes of a file what disks,
programs and people do to them, `another` that or a change of structure.
"""

from __future__ import annotations

import gzip
import importlib.util
import json
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.recordings.crowds import EthUcy
from benchmarks.recordings.landmarks import read_landmark_log
from benchmarks.recordings.ngsim import ngsim_windows
from benchmarks.recordings.openacc import openacc_platoons
from data_tools.datasets.argoverse2 import ArgoverseLogs
from data_tools.datasets.corrections import Edits, read_corrections
from data_tools.datasets.detection_files import read_detections, read_predictions, read_tracks, read_truth
from data_tools.datasets.kitti import KittiTracking
from data_tools.datasets.kitti.source import read_scored_sequences
from data_tools.datasets.labelling_tools import read_from_tool, write_for_tool
from data_tools.datasets.motchallenge import MotSequences
from data_tools.datasets.nuscenes import NuScenes, read_scored_scenes, split_scenes
from data_tools.datasets.results import SceneResult
from data_tools.laser import read_carmen
from data_tools.lidar import Scan, read_scan
from data_tools.metrics import SceneBoxes
from data_tools.pose_graphs import read_g2o
from data_tools.recordings import open_recording
from data_tools.sensor_logs import read_sensor_log
from data_tools.trajectories import read_kitti_poses, read_tum_poses
from pipelines.config import OTHER_FILES, TrackConfig, load_config, load_interactions
from pipelines.configuration import load_settings
from pipelines.explaining import read_events
from pipelines.report.page import read_run_record
from pipelines.report.scenes import thumbnails
from pipelines.review import read_label_run
from pipelines.serving import StateKeeper, StreamTracker
from pipelines.slam.configuration import SlamConfig, load_slam_config
from pipelines.slam.drive import SlamMap, read_map, write_map
from saga_fg import Boxes, Dataset, GroundCamera, Scene
from saga_fg.smoothing.corrections import correction_from
from tests.benchmarks.recordings.ngsim_example import HEADER, crossing, rows
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import box, results, write_results, write_tables
from tests.data_tools.structures import restructured

PIECES = [
    *(b"", b"NaN", b"nan", b"-1", b"0", b"1e999", b"-1e308", b"1e-320", b"99999999999999999999", b"0x10", b"1_0"),
    *(b"null", b"true", b"[]", b"{}", b'""', b'"x"', b"[[[[", b"\n", b"\r\n", b"\t", b",", b" ", b";", b'"'),
    *(b"\xff", b"\x00", b"\xef\xbb\xbf", "²".encode(), "car²".encode(), b"../../x", b"!!python/object:os.system"),
    *(b"1e300", b"-1e300", b"9" * 4000, b"9" * 5000, b"[" * 5000, b"- " * 3000, b'{"a":' * 3000),
]
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")

BOXES = "1,2,300.5,400,40,120,1,1,0.9\n2,2,304.5,400,40,120,1,1,0.9\n2,3,700,500,50,150,1,1,0.9\n"
SEQUENCE = "[Sequence]\nname=MOT-01\nframeRate=10\nseqLength=3\n"
CAMERA = "homography: [[0.1, 0, 1], [0, 0.1, 2], [0, 0.001, 1]]\nfocal_length: 900\ncentre: [960, 540]\nheight: 6\n"
CSV = "timestamp,sensor,label,x,y,length,ego_x,ego_y,ego_yaw\n0,a,car,1,2,3,0,0,0\n1,a,,,,,1,1,1\n"
NDJSON = '{"timestamp": 0, "x": 1, "y": 2, "label": "car", "yaw": 0.5}\n{"timestamp": 1, "sensor": "b"}\n'
CORRECTIONS = """{"what": "exists", "at": {"time": 1, "x": 2.5, "y": -3}, "value": false, "who": "a", "when": "2026"}
{"what": "same", "at": {"time": 1, "x": 2, "y": 3, "label": "car"}, "and": {"time": 2, "x": 2, "y": 3}, "scene": "s"}
{"what": "box", "at": {"time": 1, "x": 2, "y": 3}, "box": {"x": 1, "y": 2, "length": 4.5}, "deviation": {"yaw": 0.1}}
"""
TRACKS = (
    "scene,timestamp,id,label,x,y,vx,cov_xx,cov_xy,cov_yy\na,0,1,car,1,2,3,0.5,0.1,0.5\na,1,1,car,2,2,3,0.5,0,0.5\n"
)
OTHERS = (
    "time,track_id,category,pos_x,pos_y,qw,qz,visible\n2023-11-14T22:13:20Z,a,CAR,1,2,1,0,1\n"
    "2023-11-14T22:13:20.1Z,a,CAR,1.5,2,0.8,0.6,0\n"
)
LABELS = TRACKS.replace("cov_yy\n", "cov_yy,yaw_variance,source,quality\n").replace("0.5\n", "0.5,0.1,observed,high\n")
G2O_2D = (
    "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nEDGE_SE2 0 1 1 0 0.1 100 0 0 100 0 400\n"
    "EDGE_SE2 1 0 -1 0 -0.1 100 0 0 100 0 400\nVERTEX_XY 2 1 1\nEDGE_SE2_XY 0 2 1 1 100 0 100\n"
    "EDGE_SE2_XY 1 2 1.5 2 100 0 100\nEDGE_PRIOR_SE2_XY 1 1 0 4 0 4\nFIX 0\n"
)
UNIT = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
G2O_3D = f"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\nEDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {UNIT}\n"
G2O_3D += "PARAMS_SE3OFFSET 0 0 0 1 0 0 0 1\nVERTEX_TRACKXYZ 2 1 1 1\nEDGE_SE3_TRACKXYZ 0 2 0 1 1 0 100 0 0 100 0 100\n"
G2O_3D += f"EDGE_SE3_PRIOR 0 0 0 0 0 0 0 0 1 {UNIT}\nEDGE_SE3_XYZ_PRIOR 1 0 1 0 0 4 0 0 4 0 4\n"
POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 2 0 0 1 3\n"
TUM = "# timestamp tx ty tz qx qy qz qw\n0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n"
CONFIG = "tracker:\n  max_delay: 0.5\n  classes:\n    car: {max_distance: 3.0}\nsensors:\n  default: {score: logit}\n"
RECORD = json.dumps({"method": "kf", "version": "1", "configuration": "a", "milliseconds": {"s": [1.0, 2.0]}})
LABEL_RUN = 'dataset: file\noptions: "detections: [a.csv]"\nmethod: kf\ntracks: []\ncorrections: ""\ndirectory: .\n'
LABEL_RECORD = json.dumps({**json.loads(RECORD), "configuration": LABEL_RUN})
MESSAGES = (
    '{"seq": 1, "timestamp": 0.5, "sensor": "a", "coordinates": "ego", "ego": {"x": 1, "y": 2, "yaw": 0.1}, '
    '"detections": [{"x": 1, "y": 2, "label": "car", "length": 4, "width": 2, "height": 1, "score": 0.5}]}\n'
    '{"type": "status"}\n{"timestamp": 0.6, "detections": []}\n{"type": "reset"}\n'
)
PCD = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n1 2 3\n4 5 6\n"
)
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    "1 2 3\n4 5 6\n"
)
PARK = "ODOMETRY 0 1 1.5 0 0 0.01 0 0 0.02 0 0.03\nLANDMARK 1 2 4 -1 0.4 0.1 0.5\n"
PLAZA = {
    "DR": "10.0 0.5 0.1\n10.2\t0.25\t-0.1\n",
    "TD": "10.15 2 3 12\n10.1 2 7 30.5\n",
    "GT": "10 1 2 0.5\n10.2 3 4 0.6\n",
    "TL": "7 20 30\n3 -1 -2\n",
}
OBSMAT = "780 1 8.0 0 3.0 1.0 0 0.0\n786 1 8.4 0 3.0 1.0 0 0.0\n786 2 1.0 0 2.0 0.0 0 -0.5\n"
READINGS = " ".join(f"{1 + k / 10:.2f}" for k in range(11))
FLASER = "".join(f"FLASER 11 {READINGS} {k}.2 2.0 0 {k} 2.0 0 {k}.5 nohost 0.1\n" for k in (1, 2))
ROBOT = f"ROBOTLASER1 0 -1.57 3.14 0.314 5 0.01 0 11 {READINGS} 0 1.2 2 0.5 1 2 0.5 0 0 0 0 0 17.5 nohost 0.1\n"
GPS = "time [s],latitude [deg],longitude [deg],altitude [m]\n0,49.0,8.4,110\n1,49.00001,8.4,110.5\n"
SLAM = "slam:\n  lidar:\n    loops: {drift: 0.05}\n  landmarks: []\nsensors:\n  default: {}\n"
INTERACTIONS = (
    "format: saga-fg interactions\nedges:\n- {kind: following, classes: [car], rate: 0.5}\nexplained_noise: 0.5\n"
)
PREDICTIONS = "scene,timestamp,horizon,id,label,x,y,cov_xx,cov_xy,cov_yy\na,0,1,1,car,1,2,0.5,0.1,0.5\n"
JOURNAL = '{"event": "initiated", "track": 1, "scene": "a"}\n{"event": "deleted", "track": 1, "scene": "a"}\n'


@dataclass(frozen=True)
class Target:
    """The valid files of an input, and how to read it."""

    files: tuple[Path, ...]
    read: Callable[[], object]


def targets(folder: Path) -> dict[str, Target]:
    """An input for every reader, below an empty folder."""
    nuscenes = folder / "nuscenes"
    write_tables(nuscenes)
    found, tracked = write_results(nuscenes / "found.json"), nuscenes / "tracked.json"
    write_results(tracked, {token: [_tracked(token)] * (token == "a0") for token in (*results(), "b1")})
    kitti = write_sequence(folder / "kitti")
    made = kitti / "results"
    made.mkdir()
    (made / "0007.txt").write_text("0 1 Car 0 0 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.57 0.9\n")

    def table(name: str, content: str | bytes) -> Path:
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def one(name: str, content: str | bytes, read: Callable[[Path], object]) -> Target:
        path = table(name, content)
        return Target((path,), lambda: read(path))

    npz = folder / "table.npz"
    np.savez(npz, timestamp=[0.0, 1.0], x=[1.0, 2.0], y=[3.0, 4.0], label=["car", "bus"])
    npy = folder / "scan.npy"
    np.save(npy, np.ones((3, 4), dtype=np.float32))
    plaza = tuple(table(f"P_{kind}.txt", content) for kind, content in PLAZA.items())
    (folder / "eth").mkdir()
    lasers = (table("a.log", FLASER), table("b.log", ROBOT), table("c.log.gz", gzip.compress(FLASER.encode())))
    config, slam = load_config("file"), load_slam_config("kitti")
    return {
        **_argoverse(folder / "argoverse"),
        "nuScenes": Target(tuple(sorted((nuscenes / "v1.0-mini").glob("*.json"))), lambda: _read_nuscenes(nuscenes)),
        "nuScenes detections": Target((found,), lambda: _read_nuscenes(nuscenes)),
        "nuScenes results": Target((tracked,), lambda: read_scored_scenes(tracked, nuscenes, "v1.0-mini")),
        "KITTI": Target(tuple(p for p in sorted(kitti.rglob("*.txt")) if p.stat().st_size), lambda: _read_kitti(kitti)),
        "KITTI results": Target((made / "0007.txt",), lambda: read_scored_sequences(made, kitti)),
        "detections, CSV": one("table.csv", CSV, _read_table),
        "detections, NDJSON": one("table.ndjson", NDJSON, _read_table),
        "detections, NumPy": Target((npz,), lambda: _read_table(npz)),
        "tracks": one("tracks.csv", TRACKS, read_tracks),
        "tracks of others": one("others.csv", OTHERS, lambda path: _scenes_of(read_truth(path))),
        **_arrow(folder),
        "labels": one("labels.csv", LABELS, lambda path: read_tracks(path, labels=True)),
        "pose graph, plane": one("plane.g2o", G2O_2D, read_g2o),
        "pose graph, space": one("space.g2o", G2O_3D, read_g2o),
        "poses, KITTI": one("poses.txt", POSES, read_kitti_poses),
        "poses, TUM": one("poses.tum", TUM, read_tum_poses),
        "scan, KITTI": one("scan.bin", np.ones(12, dtype="<f4").tobytes(), read_scan),
        "scan, nuScenes": one("scan.pcd.bin", np.ones(15, dtype="<f4").tobytes(), read_scan),
        "scan, PCD": one("scan.pcd", PCD, read_scan),
        "scan, PLY": one("scan.ply", PLY, read_scan),
        "scan, NumPy": Target((npy,), lambda: read_scan(npy)),
        "log of a sensor": one("gps.csv", GPS, lambda path: read_sensor_log(path, "gps")),
        "laser logs": Target(lasers, lambda: [read_carmen(path) for path in lasers]),
        "map": _map(folder / "map"),
        "MOTChallenge": _images(folder / "MOT-01"),
        "camera": one("camera.yaml", CAMERA, lambda path: load_settings(GroundCamera, path)),
        "configuration": one("config.yaml", CONFIG, lambda path: load_settings(TrackConfig, path, config, OTHER_FILES)),
        "configuration of SLAM": one("slam.yaml", SLAM, lambda path: load_settings(SlamConfig, path, slam)),
        "interactions": one("interactions.yaml", INTERACTIONS, load_interactions),
        "Victoria Park": one("park.txt", PARK, read_landmark_log),
        "Plaza": Target(plaza, lambda: read_landmark_log(plaza[0])),
        "ETH and UCY": one("eth/obsmat.txt", OBSMAT, lambda path: EthUcy(folder).scene("eth")),
        **_image(folder / "image.png"),
        **_scan_folders(folder),
        **_traffic(folder),
        **_recordings(folder),
        "corrections": one("c.jsonl", CORRECTIONS, read_corrections),
        **_tools(folder / "tools"),
        "predictions": one("a.predictions.csv", PREDICTIONS, lambda path: read_predictions(folder / "a")),
        "state": _state(folder / "state.saga", config),
        "state, graph": _state(
            folder / "graph.saga", replace(config, tracker=replace(config.tracker, estimator="isam2"))
        ),
        "journal": one("tracks.csv.journal.jsonl", JOURNAL, lambda path: list(read_events(path))),
        "run record": Target((table("r.run.json", RECORD),), lambda: read_run_record(folder / "r.json")),
        "record of labels": Target((table("run.json", LABEL_RECORD),), lambda: read_label_run(folder)),
        "stream": one("messages.ndjson", MESSAGES, lambda path: _stream(path, lambda: config.new_tracker("saga"))),
    }


def _tools(folder: Path) -> dict[str, Target]:
    """The labels of two moments in the form of each labelling tool."""
    folder.mkdir()
    scene = Scene("a", np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)), ("",) * 2, ())
    boxes = Boxes.of(["car", "bus", "car"], np.ones((3, 3)), np.full((3, 3), 2.0), np.zeros(3))
    labels = SceneResult(scene, SceneBoxes(np.array([0, 0, 1]), np.array(["1", "2", "1"]), boxes, np.ones(3)))
    found = {}
    for tool in ("openlabel", "cvat", "sustechpoints"):
        path = folder / (f"{tool}.json" if tool == "openlabel" else tool)
        write_for_tool(path, tool, labels)
        files = (path,) if path.is_file() else tuple(sorted(path.rglob("*.json")))
        found[f"labels, {tool}"] = Target(files, partial(_read_tool, path, tool, labels))
    return found


def _read_tool(path: Path, tool: str, labels: SceneResult) -> SceneBoxes:
    back, frames = read_from_tool(path, tool, labels.scene, ("car", "bus"))
    for record in Edits(labels, back, frames).corrections():
        correction_from(record)
    return back


def _image(path: Path) -> dict[str, Target]:
    """An image, where Pillow is installed."""
    if importlib.util.find_spec("PIL") is None:
        return {}
    from PIL import Image

    Image.new("RGB", (40, 30), (200, 100, 50)).save(path)
    return {"image": Target((path,), lambda: thumbnails({"front": [path]}, 32))}


def _images(folder: Path) -> Target:
    """A sequence of MOTChallenge."""
    for name, content in (("det/det.txt", BOXES), ("gt/gt.txt", BOXES), ("seqinfo.ini", SEQUENCE)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    files = tuple(sorted(folder.rglob("*.*")))
    return Target(files, lambda: MotSequences(folder, GroundCamera(), truth=True).scene("MOT-01"))


def _map(folder: Path) -> Target:
    folder.mkdir()
    points = (np.ones((2, 3), dtype=np.float32),)
    write_map(folder, SlamMap(points, np.eye(4)[None], (49.0, 8.4, 110.0)))
    return Target((folder / "submaps.csv", folder / "origin.csv"), lambda: read_map(folder))


def _state(path: Path, config: TrackConfig) -> Target:
    """The state of a service; one that is taken goes on with a frame."""
    header = {"version": "1"}

    def keeper() -> tuple[StreamTracker[None], StateKeeper]:
        service: StreamTracker[None] = StreamTracker(lambda: config.new_tracker("saga"))
        return service, StateKeeper(service, path, 1.0, header)

    def read() -> object:
        service, restored = keeper()
        try:
            restored.restore()
        finally:
            restored.release()
        (answer,) = service.handle(b'{"seq": 9, "timestamp": 0.9, "detections": [{"x": 1, "y": 2}]}', None)
        return json.dumps(answer[1], allow_nan=False)

    service, kept = keeper()
    for k in range(3):
        service.handle(json.dumps({"seq": k, "timestamp": k / 10, "detections": [{"x": k, "y": 2}]}).encode(), None)
    kept.save()
    return Target((path,), read)


def _scenes_of(dataset: Dataset) -> list[Scene]:
    return [dataset.scene(name) for name in dataset.scenes]


def _arrow(folder: Path) -> dict[str, Target]:
    """Tables in the files of pyarrow, where it is installed."""
    if importlib.util.find_spec("pyarrow") is None:
        return {}
    import pyarrow
    import pyarrow.feather
    import pyarrow.parquet

    table = pyarrow.table(
        {"ts_ns": [10**18, 10**18 + 10**8], "x": [1.0, None], "y": [2.0, None], "class": ["car", None]}
    )
    parquet, feather = folder / "table.parquet", folder / "table.feather"
    pyarrow.parquet.write_table(table, parquet)
    pyarrow.feather.write_feather(table, feather, compression="uncompressed")
    return {
        "detections, Parquet": Target((parquet,), lambda: _read_table(parquet)),
        "detections, Feather": Target((feather,), lambda: _read_table(feather)),
    }


def another(path: Path, content: bytes, rng: random.Random) -> bytes:
    """An input from a valid file: its bytes damaged, or its parts changed within the format."""
    return damaged(content, rng) if rng.random() < 0.5 else restructured(path, content, rng)


def damaged(content: bytes, rng: random.Random) -> bytes:
    """The content with one to three things done to it."""
    for _ in range(rng.randint(1, 3)):
        content = rng.choice((_put, _put, _number, _number, _twice, _flip, _cut, _swap))(content, rng)
    return content


def _put(content: bytes, rng: random.Random) -> bytes:
    start, end = _slice(content, rng)
    return content[:start] + rng.choice(PIECES) + content[end:]


def _number(content: bytes, rng: random.Random) -> bytes:
    found = list(NUMBER.finditer(content))
    if not found:
        return content
    chosen = rng.choice(found)
    return content[: chosen.start()] + rng.choice(PIECES) + content[chosen.end() :]


def _twice(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if len(lines) > 1:
        k = rng.randrange(len(lines))
        return b"".join([*lines[: k + 1], *lines[k:]])
    start, end = _slice(content, rng)
    return content[:end] + content[start:]


def _flip(content: bytes, rng: random.Random) -> bytes:
    if not content:
        return content
    at = rng.randrange(len(content))
    return content[:at] + bytes([content[at] ^ 1 << rng.randrange(8)]) + content[at + 1 :]


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randint(0, len(content))]


def _swap(content: bytes, rng: random.Random) -> bytes:
    (a, b), (c, d) = sorted((_slice(content, rng), _slice(content, rng)))
    return content if b > c else content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]


def _slice(content: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randint(0, len(content))
    return start, min(len(content), start + rng.randint(0, 20))


def _tracked(token: str) -> dict[str, object]:
    found = box(token, velocity=[1.0, 0.0])
    score = found.pop("detection_score")
    return {**found, "tracking_id": "1", "tracking_name": found.pop("detection_name"), "tracking_score": score}


def _argoverse(root: Path) -> dict[str, Target]:
    """A log, where pyarrow is installed."""
    if importlib.util.find_spec("pyarrow") is None:
        return {}
    import pyarrow
    from pyarrow import feather

    pose = {name: [0.0, 0.0] for name in ("qx", "qy", "qz", "tx_m", "ty_m", "tz_m")}
    rows = {"timestamp_ns": [0, 10**8], "qw": [1.0, 1.0]} | pose
    size = {name: [1.0, 2.0] for name in ("length_m", "width_m", "height_m")}
    named = {"track_uuid": ["a", "a"], "category": ["BUS", "BUS"], "num_interior_pts": [1, 0]}
    log = root / "log"
    log.mkdir(parents=True)
    files = (log / "annotations.feather", log / "city_SE3_egovehicle.feather")
    for path, columns in zip(files, (rows | size | named, rows), strict=True):
        feather.write_feather(pyarrow.table(columns), path)
    return {"Argoverse": Target(files, lambda: ArgoverseLogs(root).scene("log"))}


def _traffic(folder: Path) -> dict[str, Target]:
    """Windows with their maps, not compressed, and platoons where pyarrow is installed."""
    (folder / "ngsim").mkdir()
    windows, maps = folder / "ngsim" / "windows.csv", folder / "ngsim" / "maps.json"
    windows.write_text("\n".join([HEADER, *rows(steps=3)]))
    maps.write_text(json.dumps({"A": crossing()}))
    found = {"NGSIM": Target((windows, maps), lambda: ngsim_windows(folder / "ngsim").read("A"))}
    if importlib.util.find_spec("pyarrow") is None:
        return found
    import pyarrow
    from pyarrow import parquet

    text = {"setting": ["a", "a"], "run": ["b", "b"]}
    numbers = {name: [1.0, 1.1] for name in ("speed", "east", "north", "gap_to_next")}
    path = folder / "platoons.parquet"
    parquet.write_table(pyarrow.table(text | {"t": [0.1, 0.2], "veh": [1, 1]} | numbers), path)
    return {**found, "OpenACC": Target((path,), lambda: openacc_platoons(folder).read("a-b"))}


def _recordings(folder: Path) -> dict[str, Target]:
    """A drive as MCAP and as SQLite, where the packages that write them are installed."""
    if any(importlib.util.find_spec(name) is None for name in ("mcap_ros2", "rosbags")):
        return {}
    from data_tools.datasets.mcap.dataset import McapRecording
    from tests.data_tools import mcap_example as example

    messages = [message for message in example.drive() if message[3] < example.START + 2 * example.STEP]
    mcap = example.write_mcap(folder / "drive.mcap", messages, plain=True)
    sqlite = next(example.write_bag(folder / "bag", messages).glob("*.db3"))
    return {
        "recording, MCAP": Target((mcap,), lambda: McapRecording(mcap).scene("drive")),
        "recording, SQLite": Target((sqlite,), lambda: McapRecording(sqlite).scene(sqlite.stem)),
        **_scan_recordings(folder),
    }


def _scan_recordings(folder: Path) -> dict[str, Target]:
    """Scans, a laser and sensors as MCAP and as SQLite."""
    from data_tools.recordings import read_bag_laser
    from tests.data_tools import mcap_example as example
    from tests.data_tools import scans_example as scans

    scan = Scan(np.arange(1.0, 13.0).reshape(4, 3), np.ones(4), np.arange(4) / 100)
    messages = scans.scan_messages([scan] * 3, scans.BEGIN + np.arange(3.0) / 10, np.eye(4))
    for k in range(3):
        time = scans.BEGIN + k / 10
        at = round(time * 1e9)
        messages.append(("/imu", scans.IMU, scans.imu_message(time, (0, 0, 9.8), (0, 0, 0)), at))
        messages.append(("/fix", scans.FIX, scans.fix_message(time, 49.0, 8.4, 110.0), at))
        messages.append(("/odom", example.ODOMETRY, scans.odometry_message(time, np.eye(4), 1.0), at))
        messages.append(("/scan", scans.LASER, scans.laser_message(time, np.ones(12), -1.0, 0.1, "lidar"), at))
    mcap = example.write_mcap(folder / "scans.mcap", messages, plain=True)
    sqlite = next(example.write_bag(folder / "scans", messages).glob("*.db3"))
    return {
        "scans, MCAP": Target((mcap,), lambda: (_read_recording(mcap), read_bag_laser(mcap))),
        "scans, SQLite": Target((sqlite,), lambda: _read_recording(sqlite)),
    }


def _read_recording(path: Path) -> object:
    found = open_recording(path)
    return found.sensors(), [found[row] for row in range(len(found))]


def _scan_folders(folder: Path) -> dict[str, Target]:
    """Scans with a table of their times, in an archive, and as surveyors have them, where laspy is installed."""
    points = np.arange(1.0, 13.0).reshape(4, 3)
    (folder / "drive").mkdir()
    for k in range(3):
        np.column_stack([points, np.ones(4)]).astype("<f4").tofile(folder / "drive" / f"{k:06d}.bin")
    table = folder / "drive" / "times.csv"
    table.write_text("name,time\n000000.bin,0.0\n000001.bin,0.1\n000002.bin,0.2\n")
    packed = folder / "packed.npz"
    np.savez(packed, points=points, intensity=np.ones(4), time=np.arange(4) / 100)
    raw = folder / "raw.bin"
    np.column_stack([np.random.default_rng(0).normal(0, [9, 5, 1], (200, 3)), np.ones(200)]).astype("<f4").tofile(raw)
    binary = folder / "binary.pcd"
    binary.write_bytes(PCD.replace("DATA ascii\n1 2 3\n4 5 6\n", "DATA binary\n").encode() + bytes(24))
    found = {
        "scans in a folder": Target((table,), lambda: _read_recording(folder / "drive")),
        "scan, archive": Target((packed,), lambda: read_scan(packed)),
        "scan, records": Target((raw,), lambda: read_scan(raw)),
        "scan, PCD of bytes": Target((binary,), lambda: read_scan(binary)),
    }
    if importlib.util.find_spec("laspy") is None:
        return found
    import laspy

    cloud = laspy.LasData(laspy.LasHeader(point_format=1, version="1.2"))
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(str(folder / "scan.las"))
    return {**found, "scan, LAS": Target((folder / "scan.las",), lambda: read_scan(folder / "scan.las"))}


def _read_nuscenes(root: Path) -> list[Scene]:
    data = NuScenes(root, "v1.0-mini", {"lidar": root / "found.json"}, ground_truth=True)
    scenes = [data.scene(name) for name in data.scenes]
    split_scenes(root, "v1.0-mini", "mini_val")
    return scenes


def _read_kitti(root: Path) -> Scene:
    return KittiTracking(root, root / "found", ground_truth=True).scene("0007")


def _read_table(path: Path) -> list[Scene]:
    data = read_detections(path)
    return [data.scene(name) for name in data.scenes]


def _stream(path: Path, new_tracker: Callable[[], object]) -> list[object]:
    service: StreamTracker[None] = StreamTracker(new_tracker)  # type: ignore[arg-type]
    answers: list[object] = []
    for line in path.read_bytes().splitlines(keepends=True):
        for _, answer in service.handle(line, None):
            json.dumps(answer, allow_nan=False)
            answers.append(answer)
    return answers
