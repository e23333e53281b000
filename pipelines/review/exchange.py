"""Labels out to a labelling tool, and the edits that were made there back as corrections."""

import json
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from data_tools.datasets.edits import Edits
from data_tools.datasets.labelling_tools import exchanged, read_from_tool, tool_format, write_for_tool
from data_tools.files import atomic_directory, parsed_json, read_text, write_text
from data_tools.lidar import ScanSequence, write_cloud
from pipelines.review.record import LabelRun, labelled_scenes
from pipelines.scale_out import file_name
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, transform_points

SCAN_TIME = 0.06  # s between a moment and its scan
WHEN = ("who", "when")  # of a correction, which do not make it another


def export_labels(folder: Path, run: LabelRun, tool: str, output: Path) -> tuple[int, int]:
    """Write the labels of a folder for a tool, a file or folder for each scene; return the numbers of boxes and scans.

    output: a new or empty folder, which appears when all is written. Raises `InputError` where the labels or the
    recordings can't be read, and for a folder that is not writable or holds anything: it may be somebody's edits.
    """
    form, boxes, clouds = tool_format(tool), 0, 0
    if output.is_dir() and any(output.iterdir()):
        raise InputError(f"{output}: expected a new or an empty folder, it may hold edits")
    with run.open() as (source, dataset), atomic_directory(output) as whole:
        scenes = {name: dataset.scene(name) for name in dataset.scenes}
        scans = source.surroundings(scenes).scans() if form.clouds else {}
        for result in labelled_scenes(folder, scenes):
            name = file_name(result.scene.name)
            boxes += write_for_tool(whole / f"{name}{form.suffix}", tool, result)
            for k, time in enumerate(result.scene.timestamps.tolist()):
                points = ego_points(scans.get(result.scene.name), time)
                if len(points):
                    cloud = whole / name / form.clouds / f"{k:06d}.pcd"
                    cloud.parent.mkdir(exist_ok=True)
                    write_cloud(cloud, points)
                    clouds += 1
    return boxes, clouds


def import_edits(
    folder: Path, run: LabelRun, tool: str, given: Path, file: Path, who: str = ""
) -> tuple[Counter[str], list[str]]:
    """Add what was changed in a tool to a file of corrections; return the numbers of new ones by kind, and what none of
    them can say.

    given: the folder that `export_labels` wrote, edited; scenes that it lacks are as they were. Raises `InputError` for
    what can't be read, and where none of the scenes is there; the file is unchanged then.
    """
    form, found, problems, missing = tool_format(tool), list[dict[str, object]](), list[str](), list[Path]()
    with run.open() as (source, dataset):
        scenes = {name: dataset.scene(name) for name in dataset.scenes}
        results = list(labelled_scenes(folder, scenes))
        labels = {label for each in results for label in each.found.boxes.label.tolist()}
        fixed = source.written.classes
    for result in results:
        path = given / f"{file_name(result.scene.name)}{form.suffix}"
        if not path.exists():
            missing.append(path)
            problems.append(f"{path}: there is no such scene, its labels stay as they are")
            continue
        back = read_from_tool(path, tool, result.scene, fixed or labels, not fixed)
        compared = Edits(exchanged(result), *back)
        found += compared.corrections()
        unknown = sorted(set(back[0].boxes.label.tolist()) - labels) if not fixed else []
        problems += [f"{path}: class {name}: taken over, no label has had it before" for name in unknown]
        problems += [f"{path}: {line}" for line in compared.problems]
    if len(missing) == len(results):
        raise InputError(f"{given}: expected {missing[0].name}, as written by --export {tool}")
    lines = read_text(file).splitlines() if file.exists() else []
    there = [_plain(parsed_json(line, str(file))) for line in lines if line.strip()]
    new = [record for record in found if record not in there]
    about = {"who": who, "when": datetime.now(UTC).isoformat(timespec="seconds")}
    if new:
        write_text(file, "".join(f"{line}\n" for line in [*lines, *(json.dumps({**each, **about}) for each in new)]))
    return Counter(str(record["what"]) for record in new), problems


def _plain(record: object) -> object:
    """A correction without its author and time."""
    return {k: v for k, v in record.items() if k not in WHEN} if isinstance(record, dict) else record


def ego_points(scans: ScanSequence | None, time: float) -> FloatArray:
    """Points (N, 3) of the scan of a moment, m, in coordinates of the vehicle; none where there is no scan then."""
    late = np.abs(scans.timestamps - time) if scans is not None else np.empty(0)
    if scans is None or not len(late) or late.min() > SCAN_TIME:
        return np.empty((0, 3))
    return transform_points(scans.ego_T_lidar, scans[int(np.argmin(late))].points)
