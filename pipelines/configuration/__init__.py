"""Settings dataclasses from and to YAML."""

from pipelines.configuration.reading import load_settings, read_settings
from pipelines.configuration.writing import write_settings

__all__ = ["load_settings", "read_settings", "write_settings"]
