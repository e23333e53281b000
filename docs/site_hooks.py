"""Hooks of MkDocs: the tables of all settings, and pages at the top of the repository, links to them included.

In the repository a page of docs/ links to `../CONTRIBUTING.md`, which is outside the folder that MkDocs knows.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from mkdocs.structure.files import File
from settings_tables import settings_reference

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

TOP = Path(__file__).resolve().parents[1]
TOP_PAGES = ("CONTRIBUTING.md", "CHANGELOG.md")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the top folder to those of docs/."""
    for name in TOP_PAGES:
        files.append(File.generated(config, name, abs_src_path=str(TOP / name)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Add the tables of settings; rewrite links between docs/ and the top folder, which are one folder on the site."""
    if page.file.src_uri == "configuration.md":
        return f"{markdown}\n{configuration_tables()}"
    if page.file.src_uri in TOP_PAGES:
        return re.sub(r"\]\(docs/", "](", markdown)
    return re.sub(rf"\]\(((?:\.\./)*)\.\./({'|'.join(map(re.escape, TOP_PAGES))})", r"](\1\2", markdown)


def configuration_tables() -> str:
    """Tables of all settings in Markdown, from their dataclasses."""
    from data_tools.simulator import SimulatorSettings
    from pipelines.config import TrackConfig
    from pipelines.serving import StreamSettings
    from pipelines.slam.configuration import SlamSettings
    from saga_fg import providers
    from saga_fg.smoothing import SmoothingSettings

    classes = {
        "Tracking (`saga-fg track`, `saga-fg demo`)": TrackConfig,
        "Smoothing (`saga-fg smooth`, below `smoothing`)": SmoothingSettings,
        "SLAM (`saga-fg slam`, below `slam`)": SlamSettings,
        "Limits of the service (`saga-fg serve --limits`)": StreamSettings,
        "The simulator (`saga-fg simulate`)": SimulatorSettings,
    }
    for name in ("Odometry", "Gps", "Imu", "Wheels", "Landmarks", "LaneKeeping"):
        classes[f"Factor provider `saga_fg.providers:{name}`"] = getattr(providers, name)
    documented: dict[tuple[type, str], str] = {}
    return "\n".join(f"## {title}\n\n{settings_reference(cls, documented)}" for title, cls in classes.items())
