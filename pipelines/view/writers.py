"""Drawings as files: .rrd for rerun, .mcap for Foxglove and other readers.

Drawings as a file of MCAP (https://mcap.dev) for Foxglove, and for other readers of its messages.

A pose is a `FrameTransforms`, points without names a `PointCloud` of float32 x, y, z, every other shape a `SceneUpdate`
that first deletes all its layer showed before: each message is complete, so that playback may begin anywhere. Solids
with facts are an entity each, named by the first fact and with all of them as metadata; other shapes are one entity.

The path of a drawing is the topic of its messages, its frame the message's. Messages are protobuf with the fields that
Foxglove publishes (https://docs.foxglove.dev/docs/sdk/schemas); times are nanoseconds from the scene's start.

Drawings for rerun (https://rerun.io): a file .rrd, written whole or not at all, or a viewer on the screen.

Paths are rerun's entities, frames its transforms; times are on the timelines `time`, s, and `moment`.
"""

from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, assert_never

import numpy as np

from data_tools.files import atomic_file, check_writable
from pipelines.view.scenes import Arrows, Drawing, Lines, Points, Pose, Shape, Solids
from saga_fg.errors import InputError, require_extra
from saga_fg.numerics import FloatArray, IntArray, rotation_quaternion, yaw_quaternion

OPACITY = 0.4  # of solids
TEXT_SIZE, TEXT_GAP = 12.0, 0.3  # pixels; m above the named thing
UP = np.array([0.0, 0.0, 1.0])
HEAD = 0.25  # of an arrow's length

Fields = dict[str, Any]
"""Fields of a message by name; those left out have protobuf's defaults."""
IDENTITY: Fields = {"position": {}, "orientation": {"w": 1.0}}


def load_mcap() -> Any:
    """The class that writes messages. Raises `MissingExtraError` where its packages are not installed."""
    require_extra("mcap", "a file for Foxglove", "mcap", "mcap_protobuf", "foxglove_schemas_protobuf")
    from mcap_protobuf.writer import Writer

    return Writer


def write_mcap(path: Path, drawings: Iterable[Drawing]) -> None:
    """Write drawings in order of time.

    Raises `InputError` where the file cannot be written, `MissingExtraError` without mcap.
    """
    with atomic_file(path) as file:
        writer = load_mcap()(file)
        for each in drawings:
            time = _nanoseconds(each)
            writer.write_message(f"/{each.path}", _message(each), log_time=time, publish_time=time)
        writer.finish()


def _nanoseconds(drawing: Drawing) -> int:
    """Time to the microsecond (seconds since 1970 are no finer); 0 for static drawings."""
    return 1000 * round(1e6 * (drawing.time or 0.0))


def _message(drawing: Drawing) -> Any:
    """A `FrameTransforms`, `PointCloud` or `SceneUpdate`."""
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    shape = drawing.shape
    seconds, nanoseconds = divmod(_nanoseconds(drawing), 10**9)
    fields: Fields
    stamp: Fields = {"timestamp": {"seconds": seconds, "nanos": nanoseconds}}
    if isinstance(shape, Pose):
        matrix = shape.parent_T_child[None]
        (translation,), (rotation,) = _xyz(matrix[:, :3, 3]), _quaternions(rotation_quaternion(matrix[:, :3, :3]), 9)
        frames = {"parent_frame_id": drawing.frame, "child_frame_id": drawing.path}
        fields = {"transforms": [{**stamp, **frames, "translation": translation, "rotation": rotation}]}
        return FrameTransforms(**fields)
    if isinstance(shape, Points) and shape.names is None:
        xyz = [{"name": name, "offset": 4 * k, "type": PackedElementField.FLOAT32} for k, name in enumerate("xyz")]
        points = shape.points.astype("<f4").tobytes()
        fields = {"frame_id": drawing.frame, "pose": IDENTITY, "point_stride": 12, "fields": xyz, "data": points}
        return PointCloud(**stamp, **fields)
    common = {**stamp, "frame_id": drawing.frame, "frame_locked": drawing.time is None}
    fields = {
        "deletions": [{**stamp, "type": SceneEntityDeletion.ALL}],
        "entities": [{**common, **entity} for entity in _entities(drawing.name, shape)],
    }
    return SceneUpdate(**fields)


def _entities(layer: str, shape: Solids | Lines | Arrows | Points) -> list[Fields]:
    """Identifiers, metadata and primitives of a shape's entities."""
    match shape:
        case Solids():
            kind = "spheres" if shape.round else "cubes"
            solids = _solids(shape.centre, shape.size, shape.yaw, shape.colour)
            if not shape.facts:
                return [{"id": layer, kind: solids}]
            texts = _texts(shape.centre + UP * (shape.size / 2 + TEXT_GAP), shape.labels, shape.colour)
            return [
                {
                    "id": row[0],
                    "metadata": [{"key": key, "value": value} for key, value in zip(shape.facts, row, strict=True)],
                    kind: [solid],
                    "texts": [text],
                }
                for row, solid, text in zip(zip(*shape.facts.values(), strict=True), solids, texts, strict=True)
            ]
        case Points():
            size, yaw = np.full(shape.points.shape, 2 * shape.radius), np.zeros(len(shape.points))
            texts = _texts(shape.points + TEXT_GAP * UP, shape.names or (), shape.colour)
            return [{"id": layer, "spheres": _solids(shape.points, size, yaw, shape.colour), "texts": texts}]
        case Lines():
            return [{"id": layer, "lines": _lines(shape)}]
        case Arrows():
            return [{"id": layer, "arrows": _arrows(shape)}]
    assert_never(shape)


def _solids(centre: FloatArray, size: FloatArray, yaw: FloatArray, colour: IntArray) -> list[Fields]:
    poses, sizes, colours = _poses(centre, yaw), _xyz(size), _mcap_colours(colour, len(centre), OPACITY)
    return [{"pose": p, "size": s, "color": c} for p, s, c in zip(poses, sizes, colours, strict=True)]


def _texts(place: FloatArray, texts: Sequence[str], colour: IntArray) -> list[Fields]:
    poses, colours = _poses(place, np.zeros(len(place))), _mcap_colours(colour, len(place))
    look = {"billboard": True, "font_size": TEXT_SIZE, "scale_invariant": True}
    return [{"pose": p, **look, "color": c, "text": t} for p, c, t in zip(poses, colours, texts, strict=True)]


def _lines(shape: Lines) -> list[Fields]:
    """Line strips, the first type of line and so the default."""
    count = len(shape.strips)
    thickness = np.broadcast_to((2 * shape.radius).round(3), (count,)).tolist()
    return [
        {"pose": IDENTITY, "thickness": thick, "points": _xyz(strip), "color": colour}
        for strip, thick, colour in zip(shape.strips, thickness, _mcap_colours(shape.colour, count), strict=True)
    ]


def _arrows(shape: Arrows) -> list[Fields]:
    length = np.hypot(*shape.vector.T)
    poses = _poses(shape.tail, np.arctan2(shape.vector[:, 1], shape.vector[:, 0]))
    diameters = {"shaft_diameter": 2 * shape.radius, "head_diameter": 4 * shape.radius}
    return [
        {"pose": pose, "shaft_length": (1 - HEAD) * long, "head_length": HEAD * long, **diameters, "color": colour}
        for pose, long, colour in zip(
            poses, length.round(3).tolist(), _mcap_colours(shape.colour, len(length)), strict=True
        )
    ]


def _poses(place: FloatArray, yaw: FloatArray) -> list[Fields]:
    turns = _quaternions(yaw_quaternion(yaw), 5)
    return [{"position": p, "orientation": q} for p, q in zip(_xyz(place), turns, strict=True)]


def _xyz(rows: FloatArray) -> list[Fields]:
    """Vectors (N, 3), to the millimetre."""
    return [{"x": x, "y": y, "z": z} for x, y, z in rows.round(3).tolist()]


def _quaternions(rows: FloatArray, digits: int) -> list[Fields]:
    """Quaternions (N, 4), (w, x, y, z)."""
    return [{"x": x, "y": y, "z": z, "w": w} for w, x, y, z in rows.round(digits).tolist()]


def _mcap_colours(colour: IntArray, count: int, opacity: float = 1.0) -> list[Fields]:
    rows = np.broadcast_to((colour / 255).round(3), (count, 3)).tolist()
    return [{"r": r, "g": g, "b": b, "a": opacity} for r, g, b in rows]


APPLICATION = "saga-fg"


def load_rerun() -> ModuleType:
    """The package rerun. Raises `MissingExtraError` where it is not installed."""
    require_extra("view", "the 3D view", "rerun")
    return import_module("rerun")


def write_rerun(path: Path, name: str, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    """Write a file that rerun opens.

    name   of the recording, for the viewer's list
    roots  frames that get a 3D view each

    Raises `InputError` where the file cannot be written, `MissingExtraError` without rerun.
    """
    rerun = load_rerun()
    with atomic_file(path) as file:
        stream = rerun.RecordingStream(APPLICATION, recording_id=name)
        stream.save(file.name, default_blueprint=_blueprint(roots))
        try:
            _log(stream, roots, drawings)
            _flushed(stream, path)
        finally:
            stream.disconnect()


def _flushed(stream: Any, path: Path) -> None:
    try:
        stream.flush()
    except RuntimeError as error:  # rerun writes in a thread of its own, and says no more than that it failed
        raise InputError(f"{path}: not written, is the disk full? {error}") from error


class RerunViewer:
    """Rerun's viewer on the screen, which stays open. Otherwise as `write_rerun`."""

    def __init__(self, name: str, roots: Sequence[str]) -> None:
        self._roots, self._stream = roots, load_rerun().RecordingStream(APPLICATION, recording_id=name)
        self._stream.spawn(default_blueprint=_blueprint(roots))

    def draw(self, drawings: Iterable[Drawing]) -> None:
        """Draw in order of time."""
        _log(self._stream, self._roots, drawings)
        self._stream.flush()


def _blueprint(roots: Sequence[str]) -> Any:
    """Return a layout with a tab for each root."""
    from rerun import blueprint

    views = [blueprint.Spatial3DView(origin=f"/{root}", name=root) for root in roots]
    return blueprint.Blueprint(blueprint.Tabs(*views), collapse_panels=True)


def _log(stream: Any, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    rerun = load_rerun()
    for root in roots:
        stream.log(root, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for each in drawings:
        if each.time is not None:
            stream.reset_time()
            stream.set_time("time", duration=each.time)
        if each.moment is not None:
            stream.set_time("moment", sequence=each.moment)
        stream.log(each.path, _archetype(each.shape), static=each.time is None)


def _archetype(shape: Shape) -> Any:
    rerun = load_rerun()
    match shape:
        case Solids():
            solids = rerun.Ellipsoids3D if shape.round else rerun.Boxes3D
            return solids(
                centers=shape.centre,
                half_sizes=shape.size / 2,
                quaternions=np.roll(yaw_quaternion(shape.yaw), -1, axis=1),  # x y z w
                colors=_rerun_colours(shape),
                labels=shape.labels or None,
                show_labels=False,
            )
        case Lines():
            return rerun.LineStrips3D(shape.strips, colors=_rerun_colours(shape), radii=shape.radius)
        case Arrows():
            vector = np.column_stack([shape.vector, np.zeros(len(shape.vector))])
            return rerun.Arrows3D(
                vectors=vector, origins=shape.tail, colors=_rerun_colours(shape), radii=[shape.radius]
            )
        case Points():
            return rerun.Points3D(shape.points, radii=[shape.radius], colors=_rerun_colours(shape), labels=shape.names)
        case Pose():
            pose = shape.parent_T_child
            return rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
    assert_never(shape)


def _rerun_colours(shape: Solids | Lines | Arrows | Points) -> Any:
    return shape.colour.astype(np.uint8)


def check_view_file(path: Path) -> None:
    """Check the suffix, the package and the folder of a file for `write_view`.

    Raises `InputError`, `MissingExtraError`.
    """
    (load_mcap if _is_mcap(path) else load_rerun)()
    check_writable(path)


def write_view(path: Path, name: str, roots: Sequence[str], drawings: Iterable[Drawing]) -> None:
    """Write drawings in order of time to a file for rerun or Foxglove, whole or not at all.

    name   of the recording
    roots  frames that get a 3D view each

    Raises `InputError` for other suffixes and where the file cannot be written, `MissingExtraError` where the package
    that writes it is not installed.
    """
    if _is_mcap(path):
        write_mcap(path, drawings)
    else:
        write_rerun(path, name, roots, drawings)


def _is_mcap(path: Path) -> bool:
    if path.suffix not in (".rrd", ".mcap"):
        raise InputError(f"{path}: expected a file name that ends in .rrd (rerun) or .mcap (Foxglove)")
    return path.suffix == ".mcap"
