"""Review of labels: a page on this machine that takes corrections, and the labels solved again with them.

folder of labels + record of its run -> `ReviewSession` <-> `ReviewServer` <-> the page
                                     -> `export_labels` -> a labelling tool -> `import_edits` -> corrections
"""

from pipelines.review.exchange import LabelRun, export_labels, import_edits, read_label_run
from pipelines.review.server import CORRECTIONS, ReviewServer, ReviewSession

__all__ = [
    "CORRECTIONS",
    "LabelRun",
    "ReviewServer",
    "ReviewSession",
    "export_labels",
    "import_edits",
    "read_label_run",
]
