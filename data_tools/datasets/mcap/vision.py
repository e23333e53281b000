"""`vision_msgs/Detection3DArray`: boxes with hypotheses of classes, of which the one of highest score counts.

Results are of the same type; `id` is that of the track. There is no place for a velocity.

Source: https://github.com/ros-perception/vision_msgs, version 4 (Humble and later).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from data_tools.datasets.mcap import objects as ros
from data_tools.datasets.mcap.objects import NO_COVARIANCE, ObjectRows, frame_name, nanoseconds, wxyz, xyz
from saga_fg.types.track import Tracks

TYPES = ("vision_msgs/Detection3DArray",)
RESULT = "vision_msgs/Detection3DArray"
FIELDS = {
    "position": "detections[{}].bbox.center.position",
    "rotation": "detections[{}].bbox.center.orientation",
    "covariance": "detections[{}].results[].pose.covariance",
    "size": "detections[{}].bbox.size",
    "score": "detections[{}].results[].hypothesis.score",
    "velocity": "",
    "velocity_covariance": "",
}


def rows(message: Any) -> ObjectRows:
    """The detections of an array."""
    found = ObjectRows(nanoseconds(message.header.stamp), frame_name(message.header.frame_id), FIELDS)
    for each in message.detections:
        surest = max(each.results, key=lambda result: result.hypothesis.score, default=None)
        found.id.append(each.id)
        found.label.append(surest.hypothesis.class_id if surest is not None else "")
        found.score.append(surest.hypothesis.score if surest is not None else 1.0)
        found.position.append(xyz(each.bbox.center.position))
        found.rotation.append(wxyz(each.bbox.center.orientation))
        found.heading.append(True)
        found.size.append(xyz(each.bbox.size))
        found.velocity.append(NO_COVARIANCE[:3])
        found.covariance.append(surest.pose.covariance if surest is not None else NO_COVARIANCE)
        found.velocity_covariance.append(NO_COVARIANCE)
    return found


def result(tracks: Tracks, stamp: int, frame: str, names: Mapping[str, str]) -> ros.Fields:
    """A `Detection3DArray` of tracks."""
    boxes, head = tracks.boxes, ros.header(stamp, frame)
    detections = []
    for k, (id_, label, score) in enumerate(
        zip(tracks.id.tolist(), boxes.label.tolist(), tracks.score.tolist(), strict=True)
    ):
        place = ros.pose(boxes.position[k], boxes.yaw[k])
        hypothesis = {"class_id": names.get(label, label), "score": score}
        pose = {"pose": place, "covariance": ros.covariance(tracks.position_covariance[k])}
        detections.append(
            {
                "header": head,
                "results": [{"hypothesis": hypothesis, "pose": pose}],
                "bbox": {"center": place, "size": ros.vector(boxes.size[k])},
                "id": str(id_),
            }
        )
    return {"header": head, "detections": detections}
