"""Recordings of LiDARs and lasers in any layout: scans in order of time, and what else was recorded with them."""

from data_tools.lidar import RecordingOptions, ScanRecording
from data_tools.recordings.bags import is_bag, read_bag_laser
from data_tools.recordings.layouts import LAYOUTS, open_recording

__all__ = ["LAYOUTS", "RecordingOptions", "ScanRecording", "is_bag", "open_recording", "read_bag_laser"]
