"""The command `saga-fg`, and `python -m saga_fg`.

It takes its packages from the folder that holds this one, even where the working directory or `PYTHONPATH` offers other
folders of their names. They are found by name at run time: the library itself imports none of those above it.
"""

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

PACKAGES = ("factors", "saga_fg", "data_tools", "pipelines")
FOLDER = str(Path(__file__).resolve().parents[1])


class OwnPackages(MetaPathFinder):
    """Finds the four packages in `FOLDER`, and nothing else."""

    @classmethod
    def find_spec(
        cls, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where a package of ours is, None for any other module."""
        return PathFinder.find_spec(fullname, [FOLDER], target) if fullname in PACKAGES else None


if not any(getattr(finder, "__name__", "") == OwnPackages.__name__ for finder in sys.meta_path):
    sys.meta_path.insert(0, OwnPackages)  # on import: the processes that the command starts import this file first


def main() -> None:
    """Run the command."""
    import_module("pipelines.cli.main").main()


if __name__ == "__main__":
    main()
