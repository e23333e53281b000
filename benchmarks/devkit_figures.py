"""Print the official development kit's figures of a tracking result; run by the interpreter that has nuscenes-devkit.

python devkit_figures.py RESULT.json DATAROOT VERSION SPLIT

JSON with `figures`, as the kit's metrics serialise, and `seconds` of CPU time from files to figures.
"""

import contextlib
import io
import json
import sys
import tempfile
import time
import warnings


def main() -> None:
    """Score and print."""
    warnings.filterwarnings("ignore")
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.tracking.evaluate import TrackingEval

    result, dataroot, version, split = sys.argv[1:]
    silent = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as output,
        contextlib.redirect_stdout(silent),
        contextlib.redirect_stderr(silent),
    ):
        begin = time.process_time()
        configuration = config_factory("tracking_nips_2019")
        evaluation = TrackingEval(configuration, result, split, output, version, dataroot, verbose=False)
        metrics, _ = evaluation.evaluate()
        seconds = time.process_time() - begin
    json.dump({"figures": metrics.serialize(), "seconds": seconds}, sys.stdout)


if __name__ == "__main__":
    main()
