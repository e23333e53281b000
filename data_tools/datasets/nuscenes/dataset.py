"""The nuScenes dataset: tables, detections, scans, images and maps in; `Scene`s out.

World coordinates are the global frame of the recording's map (z up), the vehicle's frame is the tables' ego frame
(origin below the rear axle, x ahead, y left). The frames carry detections in world coordinates, one frame a sample and
sensor, at the sample's time.

The LiDAR scans of nuScenes keyframes: samples/LIDAR_TOP/*.pcd.bin, named by `sample_data`.

Many copies of the tables come without the files; a keyframe whose file is not there has no scan.

The vector maps of nuScenes, where the map expansion lies below the dataroot: maps/expansion/LOCATION.json.

    {"node": [{"token", "x", "y"}], "line": [{"token", "node_tokens"}],
     "polygon": [{"token", "exterior_node_tokens", "holes": [{"node_tokens"}]}],
     "drivable_area": [{"polygon_tokens"}], "ped_crossing" and "walkway": [{"polygon_token"}],
     "road_divider" and "lane_divider": [{"line_token"}]}

Format: https://github.com/nutonomy/nuscenes-devkit/blob/master/docs/schema_nuscenes.md and its map API.
"""

import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from data_tools.datasets.nuscenes.results import ResultFile, ResultMeta, read_result_file
from data_tools.datasets.nuscenes.tables import (
    LIDAR,
    keyframes,
    read_annotations,
    read_scenes,
    read_table,
    rigid_transform,
    table_folder,
)
from data_tools.datasets.source import AreaMap, Images, Kind, map_points
from data_tools.files import parsed_json, read_bytes
from data_tools.lidar import NUSCENES, ScanRecording, read_records
from saga_fg import InputError
from saga_fg.errors import error_context, unknown_name
from saga_fg.numerics import FloatArray
from saga_fg.types import Annotations, Detections, Frame, Scene

log = logging.getLogger(__name__)


class NuScenes:
    """Scenes of nuScenes with the detections of one or more result files, one a sensor.

    dataroot, version  the tables are in dataroot/version
    detections         sensor name -> detection-result JSON (official format)
    scenes             names of the scenes to read, None for all
    ground_truth       whether to read the annotations as well
    folder, records    of the tables: where they are, and the chosen scenes by name

    Everything is read and checked at construction; only the chosen scenes are kept. A sample that a detection file does
    not list was not looked at by that sensor and gets no frame (a list without boxes gives an empty frame).
    Raises `InputError` for whatever is missing or broken, and for a sensor that saw no sample of a chosen scene.
    """

    def __init__(
        self,
        dataroot: str | Path,
        version: str,
        detections: Mapping[str, str | Path],
        scenes: Collection[str] | None = None,
        ground_truth: bool = False,
    ) -> None:
        self.dataroot, self.version = dataroot, version
        self.folder = folder = table_folder(dataroot, version)
        self.records, all_samples = read_scenes(folder, scenes)
        self.scenes = tuple(self.records)
        wanted = {token for record in self.records.values() for token in record.tokens}
        self._paths = {sensor: Path(path) for sensor, path in detections.items()}
        self._results: dict[str, ResultFile] = {}
        for sensor, path in self._paths.items():
            self._results[sensor] = read_result_file(path, "detection", all_samples, wanted)
            missing = len(wanted - self._results[sensor].rows.keys())
            if missing:
                log.warning(
                    "%s: lists %d of %d samples, the others get no frame", path, len(wanted) - missing, len(wanted)
                )
        if scenes is not None:
            for name in self.records:
                self._check_seen(name)
        self._annotations: dict[str, list[Annotations]] | None = (
            read_annotations(folder, self.records) if ground_truth else None
        )

    @property
    def meta(self) -> ResultMeta:
        """Sensors and data that the detection files use, together."""
        return ResultMeta.union(*(result.meta for result in self._results.values()))

    def scene(self, name: str) -> Scene:
        """One of the chosen scenes; raises `InputError` for another name."""
        if name not in self.records:
            raise InputError(f"{self.dataroot}: {unknown_name('scene', name, self.scenes)}")
        self._check_seen(name)
        record = self.records[name]
        frames = [
            frame
            for token, time, pose in zip(record.tokens, record.timestamps.tolist(), record.world_T_ego, strict=True)
            for frame in self._frames(token, time, pose)
        ]
        truth: Sequence[Annotations] | None = None if self._annotations is None else self._annotations[name]
        with error_context(str(self.dataroot)):
            return Scene(name, record.timestamps, record.world_T_ego, record.tokens, frames, truth)

    def _frames(self, token: str, time: float, world_T_ego: FloatArray) -> list[Frame]:
        frames = []
        for sensor, result in self._results.items():
            rows = result.rows.get(token)
            if rows is not None:
                seen = Detections(result.boxes.boxes.select(rows), result.boxes.score[rows])
                frames.append(Frame(time, sensor, seen, world_T_ego, token=token))
        return frames

    def _check_seen(self, name: str) -> None:
        tokens = self.records[name].tokens
        for sensor, result in self._results.items():
            if not any(token in result.rows for token in tokens):
                raise InputError(
                    f"{self._paths[sensor]}: expected detections of scene {name}, the file lists none of its samples"
                )


def nuscenes_scans(dataroot: Path, folder: Path, scene: str, sweeps: bool = True) -> ScanRecording | None:
    """The scans of a scene whose files are there, by the tables in `folder`; None without any.

    sweeps: those between keyframes as well. Raises `InputError` for broken tables, and for names of files outside the
    dataroot.
    """
    samples = set(read_scenes(folder, [scene])[0][scene].tokens)
    fields = ("sample_token", "ego_pose_token", "calibrated_sensor_token", "filename", "timestamp", "is_key_frame")
    rows = {
        float(time) * 1e-6: (file_below(dataroot, folder, sample, name), pose, mount)
        for sample, pose, mount, name, time, key in read_table(folder, "sample_data", fields)
        if sample in samples and LIDAR in str(name) and (sweeps or key)
    }
    times = np.array(sorted(time for time, (path, _, _) in rows.items() if path.is_file()))
    if not len(times):
        return None
    files, poses, mounts = zip(*(rows[time] for time in times.tolist()), strict=True)

    def transforms(table: str, wanted: Sequence[str]) -> FloatArray:
        every = {token: place for token, *place in read_table(folder, table, ("token", "translation", "rotation"))}
        with error_context(str(folder / f"{table}.json")):
            if lacking := [token for token in wanted if token not in every]:
                raise InputError(f"expected a record {lacking[0]}, there is none")
            return np.array([rigid_transform(*every[token]) for token in wanted])

    return ScanRecording(
        "nuscenes",
        times,
        lambda row: read_records(files[row], NUSCENES),
        lambda row: str(files[row]),
        transforms("calibrated_sensor", mounts[:1])[0],
        transforms("ego_pose", poses),
    )


def file_below(dataroot: Path, folder: Path, sample: str, name: object) -> Path:
    """The file that `sample_data` in `folder` names. Raises `InputError` for one outside the dataroot."""
    path = PurePosixPath(name) if isinstance(name, str) else PurePosixPath("..")
    if path.is_absolute() or ".." in path.parts:
        where = f"{folder / 'sample_data.json'}: sample {sample}: filename"
        raise InputError(f"{where}: expected a file below the dataroot, got {name!r}")
    return dataroot / path


FRONT_FIRST = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT")


def nuscenes_images(dataroot: Path, folder: Path, scenes: Mapping[str, Scene]) -> dict[str, Images]:
    """Return the images of each scene by camera, one or None for each moment; scenes without any are left out.

    Raises `InputError` for broken tables, and for names of files outside the dataroot.
    """
    if not any((dataroot / "samples" / camera).is_dir() for camera in FRONT_FIRST):
        return {}
    wanted = {token: (name, k) for name, scene in scenes.items() for k, token in enumerate(scene.tokens)}
    found: dict[str, dict[str, list[Path | None]]] = {}
    for sample, camera, _, name in keyframes(folder, FRONT_FIRST, wanted, "filename"):
        file = file_below(dataroot, folder, sample, name)
        if file.is_file():
            scene, k = wanted[sample]
            found.setdefault(scene, {}).setdefault(camera, [None] * len(scenes[scene]))[k] = file
    return {name: {camera: each[camera] for camera in FRONT_FIRST if camera in each} for name, each in found.items()}


AREAS: tuple[tuple[str, Kind], ...] = (
    ("drivable_area", "drivable"),
    ("walkway", "walkway"),
    ("ped_crossing", "crossing"),
)
LINES = ("road_divider", "lane_divider")
LOCATIONS = ("boston-seaport", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown")


def nuscenes_maps(dataroot: Path, folder: Path, scenes: Mapping[str, Scene]) -> dict[str, AreaMap]:
    """Return the maps of scenes whose place has a file; the tables are in `folder`.

    Raises `InputError` for broken tables and maps.
    """
    if not any((dataroot / "maps" / "expansion" / f"{place}.json").is_file() for place in LOCATIONS):
        return {}
    places = dict(read_table(folder, "log", ("token", "location")))
    scene_places = {name: places.get(log) for name, log in read_table(folder, "scene", ("name", "log_token"))}
    opened: dict[Path, _Layers] = {}
    found = {}
    for name, scene in scenes.items():
        place = scene_places.get(name)
        path = dataroot / "maps" / "expansion" / f"{place}.json"
        if place in LOCATIONS and path.is_file():
            if path not in opened:
                opened = {path: _read_layers(path)}  # one at a time: a map has tens of megabytes
            found[name] = AreaMap.around(scene, *opened[path])
    return found


_Layers = tuple[list[tuple[Kind, list[FloatArray]]], list[FloatArray]]  # areas and lines, as in `AreaMap`


def _read_layers(path: Path) -> _Layers:
    raw, layer = parsed_json(read_bytes(path), str(path)), "node"
    try:
        nodes = {row["token"]: (row["x"], row["y"]) for row in raw[layer]}
        layer = "polygon"
        rings = {
            row["token"]: [row["exterior_node_tokens"], *(hole["node_tokens"] for hole in row["holes"])]
            for row in raw[layer]
        }
        areas: list[tuple[Kind, list[FloatArray]]] = []
        for layer, kind in AREAS:
            for row in raw[layer]:
                for token in row.get("polygon_tokens", [row.get("polygon_token")]):
                    areas.append((kind, [map_points([nodes[node] for node in ring]) for ring in rings[token]]))
        layer = "line"
        nodes_of = {row["token"]: row["node_tokens"] for row in raw[layer]}
        lines = []
        for layer in LINES:
            lines += [map_points([nodes[node] for node in nodes_of[row["line_token"]]]) for row in raw[layer]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {layer}: expected a map expansion of nuScenes: {error!r}") from error
    return areas, lines
