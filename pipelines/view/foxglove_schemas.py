"""JSON Schemas of the messages of Foxglove that we write, with all fields they have.

Source: https://docs.foxglove.dev/docs/sdk/schemas (SceneUpdate, FrameTransforms, PointCloud and what these consist of).
Lengths in m, colours from 0 to 1, data in base64. Foxglove goes by the fields' names and types, and by the name of the
schema.
"""

from __future__ import annotations

from typing import Any

JsonSchema = dict[str, Any]


def _message(title: str, **fields: JsonSchema) -> JsonSchema:
    return {"title": title, "type": "object", "properties": fields}


def _many(item: JsonSchema) -> JsonSchema:
    return {"type": "array", "items": item}


def _one_of(title: str, *names: str) -> JsonSchema:
    """Constants from 0."""
    return {"title": title, "oneOf": [{"title": name, "const": k} for k, name in enumerate(names)]}


_NUMBER, _TEXT, _FLAG = {"type": "number"}, {"type": "string"}, {"type": "boolean"}
_WHOLE, _COUNT = {"type": "integer"}, {"type": "integer", "minimum": 0}
_BYTES = {"type": "string", "contentEncoding": "base64"}
_NANOSECONDS = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
_TIME = _message("time", sec=_COUNT, nsec=_NANOSECONDS)
_DURATION = _message("duration", sec=_WHOLE, nsec=_NANOSECONDS)
_VECTOR = _message("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT = _message("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _message("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _message("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR = _message("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)

_ARROW = _message(
    "foxglove.ArrowPrimitive",
    pose=_POSE,
    shaft_length=_NUMBER,
    shaft_diameter=_NUMBER,
    head_length=_NUMBER,
    head_diameter=_NUMBER,
    color=_COLOUR,
)
_CUBE = _message("foxglove.CubePrimitive", pose=_POSE, size=_VECTOR, color=_COLOUR)
_SPHERE = _message("foxglove.SpherePrimitive", pose=_POSE, size=_VECTOR, color=_COLOUR)
_CYLINDER = _message(
    "foxglove.CylinderPrimitive", pose=_POSE, size=_VECTOR, bottom_scale=_NUMBER, top_scale=_NUMBER, color=_COLOUR
)
_LINE = _message(
    "foxglove.LinePrimitive",
    type=_one_of("foxglove.LineType", "LINE_STRIP", "LINE_LOOP", "LINE_LIST"),
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_many(_POINT),
    color=_COLOUR,
    colors=_many(_COLOUR),
    indices=_many(_COUNT),
)
_TRIANGLES = _message(
    "foxglove.TriangleListPrimitive",
    pose=_POSE,
    points=_many(_POINT),
    color=_COLOUR,
    colors=_many(_COLOUR),
    indices=_many(_COUNT),
)
_TEXT_PRIMITIVE = _message(
    "foxglove.TextPrimitive",
    pose=_POSE,
    billboard=_FLAG,
    font_size=_NUMBER,
    scale_invariant=_FLAG,
    color=_COLOUR,
    text=_TEXT,
)
_MODEL = _message(
    "foxglove.ModelPrimitive",
    pose=_POSE,
    scale=_VECTOR,
    color=_COLOUR,
    override_color=_FLAG,
    url=_TEXT,
    media_type=_TEXT,
    data=_BYTES,
)
_ENTITY = _message(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    metadata=_many(_message("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_many(_ARROW),
    cubes=_many(_CUBE),
    spheres=_many(_SPHERE),
    cylinders=_many(_CYLINDER),
    lines=_many(_LINE),
    triangles=_many(_TRIANGLES),
    texts=_many(_TEXT_PRIMITIVE),
    models=_many(_MODEL),
)
_DELETION = _message(
    "foxglove.SceneEntityDeletion",
    timestamp=_TIME,
    type=_one_of("foxglove.SceneEntityDeletionType", "MATCHING_ID", "ALL"),
    id=_TEXT,
)
_TRANSFORM = _message(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_QUATERNION,
)
_NUMERIC = ("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")
_FIELD = _message(
    "foxglove.PackedElementField", name=_TEXT, offset=_COUNT, type=_one_of("foxglove.NumericType", *_NUMERIC)
)

SCENE_UPDATE = "foxglove.SceneUpdate"
FRAME_TRANSFORMS = "foxglove.FrameTransforms"
POINT_CLOUD = "foxglove.PointCloud"
SCHEMAS: dict[str, JsonSchema] = {
    schema["title"]: schema
    for schema in (
        _message(SCENE_UPDATE, deletions=_many(_DELETION), entities=_many(_ENTITY)),
        _message(FRAME_TRANSFORMS, transforms=_many(_TRANSFORM)),
        _message(
            POINT_CLOUD,
            timestamp=_TIME,
            frame_id=_TEXT,
            pose=_POSE,
            point_stride=_COUNT,
            fields=_many(_FIELD),
            data=_BYTES,
        ),
    )
}
