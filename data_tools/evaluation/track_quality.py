"""Ghosts and rank quality of whole tracks, class by class, as a table and for programs."""

from __future__ import annotations

from data_tools.figures import FigureTable, cell
from data_tools.metrics import TrackSummary, WholeTracks, track_summaries

_TITLE = "Whole tracks; rank quality: average precision by mean score"
_COLUMNS = ("class", "tracks", "true", "ghosts", "ghost share", "rank quality")


def track_table(tracks: WholeTracks) -> FigureTable:
    """Table for people."""
    return FigureTable(_TITLE, _COLUMNS, tuple((name, *_cells(f)) for name, f in track_summaries(tracks).items()))


def _cells(f: TrackSummary) -> tuple[str, ...]:
    return (*map(cell, (f.tracks, f.true, f.ghosts)), cell(f.ghost_share), cell(f.rank_quality))
