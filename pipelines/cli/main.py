"""The entry point of the installed command, which listens to SIGTERM before anything slow is imported."""

import sys
from importlib import import_module

from pipelines.cli.termination import TERMINATED, Terminated, ignore_sigterm, raise_on_sigterm


def main() -> None:
    """Run the command `saga-fg`."""
    run("pipelines.cli.commands", "saga-fg")


def run(module: str, name: str) -> None:
    """Run the `app` of a module, which ends in `SystemExit`; after SIGTERM, when all is tidied up, with code 143."""
    raise_on_sigterm()
    try:
        import_module(module).app(prog_name=name)
    except Terminated:
        pass  # and let go of its frames, so that contexts that were just being entered end as well
    finally:
        ignore_sigterm()
    print("terminated: what was complete is kept", file=sys.stderr)
    sys.exit(TERMINATED)
