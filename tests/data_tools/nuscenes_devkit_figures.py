"""Print what the official development kit says of a tracking result: run by the interpreter that has nuscenes-devkit.

python nuscenes_devkit_figures.py RESULT.json DATAROOT VERSION SPLIT
"""

import contextlib
import io
import json
import sys
import tempfile
import warnings


def main() -> None:
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
        configuration = config_factory("tracking_nips_2019")
        evaluation = TrackingEval(configuration, result, split, output, version, dataroot, verbose=False)
        metrics, _ = evaluation.evaluate()
    json.dump(metrics.serialize(), sys.stdout)


if __name__ == "__main__":
    main()
