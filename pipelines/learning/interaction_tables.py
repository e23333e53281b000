"""Learned interactions as tables, and as figures for programs: which form was taken, and what it does by situation."""

from __future__ import annotations

from typing import Any

from data_tools.figures import FigureTable, cell
from pipelines.learning.interactions import BASE, LearnedForms
from pipelines.learning.situation_figures import situation_figures, situation_tables

TITLE = "recordings held out"


def learned_tables(learned: LearnedForms) -> list[FigureTable]:
    """The forms that were tried, and the errors in the gaps of recordings held out."""
    rows = tuple(
        (", ".join(group), form, cell(ratio, 3), "written" if form == learned.forms[group] else "")
        for group, ratios in learned.ratios.items()
        for form, ratio in ratios.items()
    )
    columns = ("classes", "form", f"errors / those of the {BASE}", "")
    forms = FigureTable(f"{TITLE}: forms of the edges", columns, rows)
    return [table for table in (forms, *situation_tables(learned.runs, TITLE, BASE)) if table.rows]


def learned_figures(learned: LearnedForms) -> dict[str, Any]:
    """For programs: what the tables show."""
    return {
        "forms": [
            {"classes": group, "form": learned.forms[group], "ratios": ratios}
            for group, ratios in learned.ratios.items()
        ],
        "reference": BASE,
        "situations": situation_figures(learned.runs, BASE),
    }
