"""Hooks of MkDocs: the tables of all settings, and pages at the top of the repository, links to them included.

In the repository a page of docs/ links to `../CONTRIBUTING.md`, which is outside the folder that MkDocs knows.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from mkdocs.structure.files import File

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
        from make_configuration import configuration_tables

        return f"{markdown}\n{configuration_tables()}"
    if page.file.src_uri in TOP_PAGES:
        return re.sub(r"\]\(docs/", "](", markdown)
    return re.sub(rf"\]\(((?:\.\./)*)\.\./({'|'.join(map(re.escape, TOP_PAGES))})", r"](\1\2", markdown)
