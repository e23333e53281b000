"""Reports: one HTML page with a player of the scenes, figures, charts and the settings; it needs no network.

result + recordings -> `ReportScene`s, tables, charts -> `report_page` -> one file
"""

from pipelines.report.drive import drive_page
from pipelines.report.figures import latency_chart
from pipelines.report.page import (
    Report,
    RunRecord,
    read_run_record,
    record_path,
    report_page,
    result_report,
    result_scenes,
)
from pipelines.report.scenes import ReportScene, scene_of_run

__all__ = [
    "Report",
    "ReportScene",
    "RunRecord",
    "drive_page",
    "latency_chart",
    "read_run_record",
    "record_path",
    "report_page",
    "result_report",
    "result_scenes",
    "scene_of_run",
]
