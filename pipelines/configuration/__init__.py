"""Settings dataclasses from and to YAML, and their reference in Markdown."""

from pipelines.configuration.reading import load_settings, read_settings
from pipelines.configuration.reference import settings_reference
from pipelines.configuration.writing import write_settings

__all__ = ["load_settings", "read_settings", "settings_reference", "write_settings"]
