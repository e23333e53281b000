"""Records of nuScenes tables and result files to write: tokens, boxes, links, instances.

Schema: https://www.nuscenes.org/nuscenes#data-format.
"""

from __future__ import annotations

import hashlib
from typing import Any

from saga_fg.numerics.geometry import yaw_quaternion
from saga_fg.types.boxes import Boxes

Record = dict[str, Any]

CATEGORY_OF_CLASS = {
    "barrier": "movable_object.barrier",
    "bicycle": "vehicle.bicycle",
    "bus": "vehicle.bus.rigid",
    "car": "vehicle.car",
    "construction_vehicle": "vehicle.construction",
    "motorcycle": "vehicle.motorcycle",
    "pedestrian": "human.pedestrian.adult",
    "traffic_cone": "movable_object.trafficcone",
    "trailer": "vehicle.trailer",
    "truck": "vehicle.truck",
}


def token(*parts: object) -> str:
    """The token of a record: a hash of the parts that identify it."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def box_fields(boxes: Boxes, decimals: int) -> list[Record]:
    """`translation`, `size` (width, length, height) and `rotation` of each box, m, rounded to `decimals`."""
    columns = zip(
        boxes.position.round(decimals).tolist(),
        boxes.size[:, [1, 0, 2]].round(decimals).tolist(),
        yaw_quaternion(boxes.yaw).tolist(),
        strict=True,
    )
    return [{"translation": position, "size": size, "rotation": rotation} for position, size, rotation in columns]


def linked(records: list[Record]) -> list[Record]:
    """The records, which are in order of time, with the tokens of their neighbours as `prev` and `next`."""
    tokens = ["", *(record["token"] for record in records), ""]
    return [
        {**record, "prev": before, "next": after}
        for record, before, after in zip(records, tokens[:-2], tokens[2:], strict=True)
    ]


def instance_record(instance: str, category: str, annotations: list[Record]) -> Record:
    """The `instance` of an object: its token, that of its category, and its annotations in order of time."""
    return {
        "token": instance,
        "category_token": category,
        "nbr_annotations": len(annotations),
        "first_annotation_token": annotations[0]["token"],
        "last_annotation_token": annotations[-1]["token"],
    }
