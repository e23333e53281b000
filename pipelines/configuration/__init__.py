"""Settings dataclasses from and to YAML, and their reference in Markdown."""

from pipelines.configuration.reading import load_settings, read_settings
from pipelines.configuration.writing import settings_reference, write_settings

__all__ = ["load_settings", "read_settings", "settings_reference", "write_settings"]
