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
    with_surroundings,
)
from pipelines.report.scenes import (
    UNMEASURED,
    Edges,
    ReportScene,
    edges_of_frames,
    latest_detections,
    scene_data,
    scene_of_run,
)

__all__ = [
    "UNMEASURED",
    "Edges",
    "Report",
    "ReportScene",
    "RunRecord",
    "drive_page",
    "edges_of_frames",
    "latency_chart",
    "latest_detections",
    "read_run_record",
    "record_path",
    "report_page",
    "result_report",
    "result_scenes",
    "scene_data",
    "scene_of_run",
    "with_surroundings",
]
