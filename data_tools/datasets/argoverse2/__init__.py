"""Argoverse 2 sensor logs: annotated boxes in the city frame, without detections."""

from data_tools.datasets.argoverse2.dataset import CLASSES, ArgoverseLogs

__all__ = ["CLASSES", "ArgoverseLogs"]
