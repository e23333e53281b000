"""Recordings of research as datasets of the command: `benchmarks.recordings:Ngsim`, `:OpenAcc` and `:EthUcySource`;
drives past landmarks, `read_landmark_log`."""

from benchmarks.recordings.crowds import EthUcySource
from benchmarks.recordings.landmarks import LandmarkLog, read_landmark_log
from benchmarks.recordings.sources import ABOVE, MAST, VEHICLE, Ngsim, OpenAcc, TrafficScenes
from benchmarks.recordings.traffic import RecordedTraffic, Recordings, overlapping

__all__ = [
    "ABOVE",
    "MAST",
    "VEHICLE",
    "EthUcySource",
    "LandmarkLog",
    "Ngsim",
    "OpenAcc",
    "RecordedTraffic",
    "Recordings",
    "TrafficScenes",
    "overlapping",
    "read_landmark_log",
]
