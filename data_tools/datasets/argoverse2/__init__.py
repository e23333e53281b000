"""Argoverse 2 sensor logs: detections in, tracks out, in the official formats."""

from data_tools.datasets.argoverse2.logs import ArgoverseLogs, ArgoverseScene
from data_tools.datasets.argoverse2.source import ArgoverseSource

__all__ = ["ArgoverseLogs", "ArgoverseScene", "ArgoverseSource"]
