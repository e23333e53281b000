"""The classes of nuScenes.

Detections have ten classes, tracks seven of them; annotations have 23 categories, of which eleven map onto the seven.
Source: the official definitions of the detection and tracking tasks, https://www.nuscenes.org/tracking, and
https://github.com/nutonomy/nuscenes-devkit/tree/master/python-sdk/nuscenes/eval.
"""

from __future__ import annotations

TRACKING_CLASSES = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")

DETECTION_CLASSES = (*TRACKING_CLASSES, "barrier", "construction_vehicle", "traffic_cone")

CATEGORY_TO_TRACKING_CLASS = {
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}
