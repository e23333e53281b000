"""The entry point of the installed command, which listens to SIGTERM before anything slow is imported."""

from __future__ import annotations

import sys

from pipelines.cli.termination import TERMINATED, Terminated, ignore_sigterm, raise_on_sigterm


def main() -> None:
    """Run the command, which ends in `SystemExit`; after SIGTERM, when all is tidied up, with exit code 143."""
    raise_on_sigterm()
    try:
        from pipelines.cli.commands import app

        app(prog_name="saga-fg")
    except Terminated:
        pass  # and let go of its frames, so that contexts that were just being entered end as well
    finally:
        ignore_sigterm()
    print("terminated: what was complete is kept", file=sys.stderr)
    sys.exit(TERMINATED)
